"""Files: written whole or not at all, tables, MAT files, meshes of a URDF, large arrays on disk."""

from .atomic import atomic_write, refuse_clash
from .columns import read_columns, write_columns
from .digits import text_of
from .meshes import MESHES, find_mesh, read_meshes
from .on_disk import GrowingBytes, field_of, let_go, room
