"""Files: written whole or not at all, columns of tables, MAT files."""

from .atomic import refuse_input, whole_file
from .columns import read_columns

__all__ = ["read_columns", "refuse_input", "whole_file"]
