"""Files: written whole or not at all, columns of tables, MAT files."""

from .atomic import refuse_input, whole_file
from .columns import Matrix, read_columns

__all__ = ["Matrix", "read_columns", "refuse_input", "whole_file"]
