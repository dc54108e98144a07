"""Files: written whole or not at all, columns of tables, MAT files."""

from .atomic import atomic_write, refuse_clash
from .columns import read_columns

__all__ = ["atomic_write", "read_columns", "refuse_clash"]
