"""Files: written whole or not at all, columns of tables, MAT files, meshes of a URDF."""

from .atomic import atomic_write, refuse_clash
from .columns import read_columns
from .meshes import MESHES, find_mesh, read_meshes

__all__ = ["MESHES", "atomic_write", "find_mesh", "read_columns", "read_meshes", "refuse_clash"]
