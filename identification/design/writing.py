"""Friction terms written into a description: only lines of friction change, comments and layout stay."""

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from acquisition.errors import AcquisitionError
from acquisition.files import atomic_write
from acquisition.robot import FrictionTerm, robot_from_files

from ..errors import IdentificationError
from .report import Lists, friction_line

_TABLE = re.compile(r"^\s*\[(\[?)\s*([\w.\"'-]+)\s*\]")
_KEY = re.compile(r"^\s*(friction|viscous|coulomb|offset|stribeck_speed_deg_s|stribeck_speed_m_s)\s*=")


def write_friction(path: Path, terms: Lists, files: Mapping[str, bytes]) -> None:
    """Put the terms into the description at `path`.

    Raises `IdentificationError`: where the file is laid out so that lines cannot be replaced; it stays as it was.
    Raises `AcquisitionError`: where it cannot be read or written.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise AcquisitionError(f"cannot be read: {error}", place=str(path)) from error
    written = with_friction(text, tuple(terms.values()))
    try:
        robot = robot_from_files({**files, "robot.toml": written.encode()}, str(path))
        found = {joint.name: joint.friction for joint in robot.joints}
    except AcquisitionError:
        found = {}
    if found != terms:
        problem = "its lines of friction cannot be replaced"
        expected = "a table of its own for each joint, a key a line; copy the printed lines"
        raise IdentificationError(problem, place=str(path), key="[[joint]]", value=None, expected=expected)
    with atomic_write(path) as partial:
        partial.write_text(written, encoding="utf-8")


def with_friction(text: str, terms: Sequence[tuple[FrictionTerm, ...]]) -> str:
    """A description's text with these terms, joint by joint; where Stribeck friction goes, its speed becomes a comment."""
    lines = text.splitlines(keepends=True)
    heads = [i for i, line in enumerate(lines) if _TABLE.match(line)]
    out, lists = lines[: heads[0] if heads else len(lines)], list(terms)
    for begin, end in pairwise([*heads, len(lines)]):
        section, head = lines[begin:end], _TABLE.match(lines[begin])
        of_joint = head is not None and head[1] == "[" and head[2] == "joint"
        out += _joint_section(section, lists.pop(0)) if of_joint and lists else section
    return "".join(out)


def _joint_section(section: list[str], terms: tuple[FrictionTerm, ...]) -> list[str]:
    """The lines of a joint; the list takes the place of its first line of friction, or stands below its type."""
    out: list[str] = []
    place, depth = None, 0
    for line in section:
        key = _KEY.match(line) if depth == 0 else None
        if depth > 0 or (key and not key[1].startswith("stribeck")):  # lists may go over several lines
            code = line.split("#")[0]
            depth += code.count("[") - code.count("]")
            place = len(out) if place is None else place
        else:
            out.append(f"# {line}" if key and "stribeck" not in terms else line)
    if place is None:
        place = next((i for i, line in enumerate(out) if re.match(r"\s*type\s*=", line)), 0) + 1
    return [*out[:place], f"{friction_line(terms)}\n", *out[place:]]
