"""The user's own robot.toml with other values in its table `[parameters]`; every other line of it stays."""

import re
import tomllib
from collections.abc import Mapping
from typing import Any

from acquisition.files import text_of

from ..errors import IdentificationError

_HEADER = re.compile(r"[ \t]*\[[ \t]*(?:parameters|\"parameters\"|'parameters')[ \t]*\][ \t]*(?:#.*)?")
_NEXT = re.compile(r"[ \t]*\[")
_INLINE = re.compile(r"[ \t]*parameters[ \t]*[.=]")


def with_parameters(text: str, values: Mapping[str, float], remark: str, urdf: str | None = None) -> str:
    """The description with the values (SI) of `[parameters]` replaced, or with the table added at its end.

    The remark, on where they are from, takes the place of the remarks directly above the table, which were on other values; a
    name in `urdf` takes the place of the URDF's. An `IdentificationError` where the file is written so that the table cannot be
    replaced line by line.
    """
    was, written = tomllib.loads(text), {name: text_of(value) for name, value in values.items()}
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines) if _HEADER.fullmatch(line)), None)
    if start is None:
        lines = [line for line in lines if not ("parameters" in was and _INLINE.match(line))]
        before, after = lines, list[str]()
    else:
        after_it = range(start + 1, len(lines))
        stop = next((i for i in after_it if _NEXT.match(lines[i])), len(lines))
        while stop > start + 1 and not lines[stop - 1].strip().partition("#")[0]:
            stop -= 1  # blank lines and remarks above the next table are its own
        while start and lines[start - 1].lstrip().startswith("#"):
            start -= 1
        before, after = lines[:start], lines[stop:]
    while before and not before[-1].strip():
        before.pop()
    table = ["", f"# {remark}", "[parameters]", *(f"{name} = {text}" for name, text in written.items())]
    if urdf is not None:
        quoted = '"' + urdf.replace("\\", "\\\\").replace('"', '\\"') + '"'
        before = [f"urdf = {quoted}" if re.match(r"urdf[ \t]*=", line) else line for line in before]
    made = "\n".join([*before, *table, *after]) + "\n"
    now: dict[str, Any] = (
        was
        | {"parameters": {name: float(value) for name, value in written.items()}}
        | ({"urdf": urdf} if urdf is not None else {})
    )
    if _read(made) != now:
        problem = "cannot be replaced line by line"
        expected = "a table of one line per value, under a line [parameters]"
        raise IdentificationError(problem, place="the fit's robot.toml", key="[parameters]", expected=expected)
    return made


def _read(text: str) -> dict[str, Any] | None:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None
