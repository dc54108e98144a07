"""Files: written whole or not at all, tables, MAT files, meshes of a URDF, large arrays on disk."""

from .atomic import atomic_write, refuse_clash
from .meshes import MESHES, find_mesh, read_meshes
from .on_disk import GrowingBytes, allocate, field_of, release_pages
from .tables import read_columns, text_of, write_columns
