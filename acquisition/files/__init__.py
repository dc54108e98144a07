"""Files: their kinds, atomic writing, tables (CSV, MAT), meshes of a URDF, arrays on disk.

It owns the way of bytes from and to the disk, whole or not at all, and contains nothing about
robots. It may use `errors` and `arrays`.
"""

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
from .whole import (
    NAMES,
    atomic_write,
    is_recording,
    kind_of,
    read_bytes,
    refuse_clash,
    write_text,
)
