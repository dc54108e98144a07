"""Files: their kinds, atomic writing, tables, MAT files, meshes of a URDF, arrays on disk."""

from .atomic import atomic_write, refuse_clash, write_text
from .kinds import NAMES, is_recording, kind_of, read_bytes
from .meshes import MESHES, find_mesh, read_meshes
from .on_disk import (
    BLOCK_ROWS,
    GrowingBytes,
    allocate,
    by_rows,
    field_of,
    kept,
    release_pages,
    taken,
)
from .tables import TableColumn, format_numbers, read_columns, scan_table, write_columns
