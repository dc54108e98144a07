"""Files: written whole or not at all, columns of tables, MAT files, meshes of a URDF, XML patched in place."""

from .atomic import atomic_write, refuse_clash
from .columns import read_columns, write_columns
from .meshes import MESHES, find_mesh, read_meshes
from .xml_source import Edits, Element, parse_xml, text_of

__all__ = [
    "MESHES",
    "Edits",
    "Element",
    "atomic_write",
    "find_mesh",
    "parse_xml",
    "read_columns",
    "read_meshes",
    "refuse_clash",
    "text_of",
    "write_columns",
]
