"""Whole files: their bytes, and their kinds by these bytes; atomic writing.

A file is written under a temporary name and renamed when it is complete. It replaces only a file of
its own kind.
"""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import Location

# The names of the kinds that the packages read and write.
NAMES = {
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
# The first bytes of each kind. Endings do not matter: a package.json is not a fit.
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
    # A comment of TOML begins in this way, too, so this comes last.
    "md": rb"# ",
}


def read_bytes(path: Path) -> bytes:
    """Read a file. Raise `BadInputError` if that fails."""
    try:
        return path.read_bytes()
    except OSError as error:
        Location(str(path)).refuse(text=f"the file cannot be read: {error.strerror}")


def kind_of(path: Path) -> str:
    """Return the kind of a file by its first bytes.

    The kind is `mcap`, `json` of a result, `toml` of a robot, `urdf` or another one. It is empty
    for kinds that are not written here. A damaged recording is recognised by its ending.
    """
    head = b""
    with suppress(OSError), path.open("rb") as file:
        # A long comment may be at the beginning.
        head = file.read(1 << 20)
    return next(
        (kind for kind, begin in _BEGINNINGS.items() if re.match(begin, head)),
        "mcap" if path.suffix.lower() == ".mcap" else "",
    )


def is_recording(path: Path) -> bool:
    """Test for a recording, by the ending or the first bytes of the file."""
    return path.suffix.lower() == ".mcap" or kind_of(path) == "mcap"


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and rename it to `path` after the block.

    The file is renamed only if the block ends without an exception. After an exception the partial
    file is removed, and an earlier file at `path` remains.

    Raises
    ------
    BadInputError : `path` is a folder, a device or a file of another `kind_of` content, its folder
        is missing or not writable, or the disk is full.
    """
    place = Location(str(path))
    place.require(path.name, text="the path has no file name")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        # Renaming the partial file to /dev/null would replace the device.
        place.require(
            not path.exists() or path.is_file(),
            text="a folder or a device cannot be replaced by a file",
            advice="Choose the name of a file",
        )
        yield partial
        _refuse_other_kind(path, kind_of(partial))
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        place.refuse(text=f"the file cannot be written: {error.strerror or error}")
    finally:
        # If the folder is missing or is a file, the error above has reported it.
        with suppress(OSError):
            partial.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text, whole or not at all. Raise as `atomic_write`."""
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")


def refuse_clash(
    inputs: Sequence[Path | None],
    *outputs: Path | None,
    overwrite: bool | None = None,
    option: str = "output",
    of_kinds: Mapping[str, Path | None] | None = None,
) -> None:
    """Refuse outputs that would replace an input, another output or a file to be kept.

    The files to be kept are recordings and files of another kind. Links to one file count as that
    file. None is a file that was not requested.

    Parameters
    ----------
    inputs : files that are read.
    outputs : files to write; their endings show their kinds.
    overwrite : whether recordings may be replaced; None if the command has no such option.
    option : argument that names the output, for errors.
    of_kinds : outputs by their kind.

    Raises
    ------
    BadInputError : an output would replace such a file.
    """
    named = [
        *((path.suffix.lower()[1:], path) for path in outputs if path is not None),
        *((kind, path) for kind, path in (of_kinds or {}).items() if path is not None),
    ]
    for k, (kind, output) in enumerate(named):
        place = Location(str(output))
        for path in inputs:
            place.require(
                path is None or not _same(output, path),
                text=f"the output is also an input ({path})",
                advice="Choose another name for the output",
            )
        place.require(
            not any((_same(output, earlier) for _, earlier in named[:k])),
            text="two outputs have this name",
            advice="Choose a different file for each output",
        )
        place.require(
            overwrite or not output.is_file() or (not is_recording(output)),
            text="the file already exists and is a recording",
            advice="Choose another name" + " or replace it" * (overwrite is not None),
            arguments=() if overwrite is None else (option, "overwrite"),
        )
        if kind and kind in NAMES:
            _refuse_other_kind(output, kind)


def _refuse_other_kind(path: Path, kind: str) -> None:
    """Refuse to replace a file that is not empty and not of this kind."""
    if path.is_file() and path.stat().st_size and (found := kind_of(path)) != kind:
        Location(str(path)).refuse(
            text=f"the file already exists and is {NAMES[found]}, not {NAMES[kind]}",
            advice="Choose another name for the output",
        )


def _same(a: Path, b: Path) -> bool:
    # The first comparison also works for a loop of links, which cannot be opened. A missing file is
    # reported when it is read.
    return os.path.realpath(a) == os.path.realpath(b) or (
        os.path.exists(a) and os.path.exists(b) and os.path.samefile(a, b)
    )
