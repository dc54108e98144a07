"""Files: written whole or not at all, tables, MAT files, meshes of a URDF, XML patched in place; large arrays on disk."""

from .atomic import atomic_write, refuse_clash
from .columns import read_columns, write_columns
from .meshes import MESHES, find_mesh, read_meshes
from .on_disk import GrowingBytes, field_of, let_go, room
from .xml_source import Edits, Element, parse_xml, text_of
