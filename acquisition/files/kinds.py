"""Files: their bytes, and their kinds by these."""

import re
from contextlib import suppress
from pathlib import Path

from ..errors import Place

NAMES = {  # of what is read and written here
    "mcap": "a recording",
    "rrd": "a Rerun file",
    "parquet": "a Parquet table",
    "json": "a result as JSON",
    "csv": "a CSV table",
    "html": "an HTML page",
    "mjcf": "a MuJoCo model",
    "urdf": "a URDF",
    "toml": "a robot.toml",
    "md": "a Markdown report",
    "": "a file of another kind",
}
# How they begin. The endings do not matter: a package.json is not a fit.
_XML = rb"(?s)(?:\xef\xbb\xbf)?\s*(?>(?:<\?.*?\?>|<!--.*?-->)\s*)*+"
_BEGINNINGS = {
    "mcap": rb"\x89MCAP",
    "rrd": rb"RRF\d|RRIO",
    "parquet": rb"PAR1",
    "json": rb'\s*\{\s*"format"',
    "csv": rb'"?(time_s|file)"?,',
    "html": rb"(?i)<!doctype html",
    "mjcf": _XML + rb"<mujoco",
    "urdf": _XML + rb"<robot(?![^>]*xacro)",
    "toml": rb"(?m)(?s:.*?)^[ \t]*(\[\[[ \t]*joint[ \t]*\]\]|joint[ \t]*=)",
    "md": rb"# ",  # also a remark of TOML
}
_HEAD_BYTES = 1 << 20  # a comment may stand above


def read_bytes(path: Path) -> bytes:
    """The content of a file. Raises `BadInputError` if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        Place(str(path)).refuse(text=f"cannot be read: {error.strerror}")


def kind_of(path: Path) -> str:
    """The kind of a file by its first bytes: `mcap`, `json` of a result, `toml` of a robot, `urdf`
    and others; empty for those that are not written here. A damaged recording is one by its ending.
    """
    head = b""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    found = (kind for kind, begin in _BEGINNINGS.items() if re.match(begin, head))
    return next(found, "mcap" if path.suffix.lower() == ".mcap" else "")


def is_recording(path: Path) -> bool:
    """Whether a file is a recording, by its ending or its first bytes."""
    return path.suffix.lower() == ".mcap" or kind_of(path) == "mcap"
