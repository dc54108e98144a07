"""Values in tables of a description: its [[joint]]s, its [parameters], and what a fit found; all
other lines stay as they are.
"""

import json
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import msgspec
from msgspec import UNSET

from acquisition.files import format_numbers

from ..errors import BadInputError
from ..report import DriveGain, FitFile

_TABLE_HEADER = re.compile(
    r"[ \t]*\[[ \t]*(?:parameters|\"parameters\"|'parameters')[ \t]*\][ \t]*(?:#.*)?"
)


def replace_in_tables(
    text: str, kind: str, values: Mapping[str, Mapping[str, Any]], place: str
) -> str:
    """A description with these values, by key, in the [[kind]] tables of these names; a key for
    None becomes a comment.
    """
    now, written = tomllib.loads(text), set()
    made, *tables = re.split(rf"(?m)^([ \t]*\[\[[ \t]*{kind}[ \t]*\]\][ \t]*(?:#.*)?)$", text)
    # headers and what follows them
    for own, header, table in zip(now[kind], tables[::2], tables[1::2], strict=False):
        for key, value in values.get(own["name"], {}).items():
            written.add(own["name"])
            line = re.compile(
                rf"(?m)^([ \t]*{key}[ \t]*=[ \t]*)(?:\[[^\]]*\]|[^#\n]*?)([ \t]*(?:#.*)?)$"
            )
            if value is None:
                own.pop(key, None)
                table = line.sub(r"# \g<0>", table)
                continue
            own[key], shown = value, json.dumps(value)
            table, found = line.subn(rf"\g<1>{shown}\g<2>", table, count=1)
            if not found:  # after the first key
                table = re.sub(r"^\n[^\n]*", rf"\g<0>\n{key} = {shown}", table)
        made += header + table
    made = made if written == values.keys() else ""
    key = f"[[{kind}]]"
    return checked_toml(made, now, place, key, f"a line {key} of each, then a line per key")


def checked_toml(made: str, now: Mapping[str, Any], place: str, key: str, expected: str) -> str:
    """An edited description, `made`, which must hold the values `now`; `key` is what was edited.

    Raises `BadInputError` where its lines are not as `expected`.
    """
    with suppress(tomllib.TOMLDecodeError):
        if tomllib.loads(made) == now:
            return made
    raise BadInputError("cannot be replaced line by line", place=place, key=key, expected=expected)


def replace_parameters(
    text: str, values: Mapping[str, float], remark: str, urdf: str | None = None
) -> str:
    """Replace the values (SI) of `[parameters]` in a description, or append the
    table; all other lines stay.

    The remark, on the origin of the values, replaces the remarks directly above the table; the name
    `urdf` replaces the URDF's. Raises `BadInputError`: the table cannot be replaced line by line.
    """
    was, shown = tomllib.loads(text), {name: format_numbers(x) for name, x in values.items()}
    lines, after = text.splitlines(), list[str]()
    start = next((i for i, line in enumerate(lines) if _TABLE_HEADER.fullmatch(line)), None)
    if start is None:
        inline = r"[ \t]*parameters[ \t]*[.=]"
        before = [line for line in lines if not ("parameters" in was and re.match(inline, line))]
    else:
        headers = (
            i for i in range(start + 1, len(lines)) if lines[i].lstrip(" \t").startswith("[")
        )
        stop = next(headers, len(lines))
        while stop > start + 1 and not lines[stop - 1].strip().partition("#")[0]:
            stop -= 1  # blank lines and remarks above the next table belong to that table
        while start and lines[start - 1].lstrip().startswith("#"):
            start -= 1
        before, after = lines[:start], lines[stop:]
    while before and not before[-1].strip():
        before.pop()
    now: dict[str, Any] = was | {"parameters": {name: float(x) for name, x in shown.items()}}
    if urdf is not None:
        now["urdf"], quoted = urdf, '"' + urdf.replace("\\", "\\\\").replace('"', '\\"') + '"'
        before = [f"urdf = {quoted}" if re.match(r"urdf[ \t]*=", line) else line for line in before]
    table = ["", f"# {remark}", "[parameters]", *map(" = ".join, shown.items())]
    return checked_toml(
        "\n".join([*before, *table, *after, ""]),
        now,
        "the fit's robot.toml",
        "[parameters]",
        "one line per value under a line [parameters]",
    )


def with_findings(stored: FitFile, place: str) -> tuple[FitFile, list[str]]:
    """The fit with what it found in its description, and lines on that: its drive gains, and the
    control law of its recording where none is described.

    A gain that is not determined is left as described; without a described one it is written with
    its wide interval. Raises `BadInputError` where a table cannot be replaced line by line.
    """
    text, lines = stored.description.get("robot.toml", ""), list[str]()
    place = f"the robot.toml in {place}"
    if text and stored.gains is not UNSET:
        written = {
            gain.motor: _keys(gain)
            for gain in stored.gains
            if gain.determined or gain.described is None
        }
        text = replace_in_tables(text, "motor", written, place)
        lines += [_gain_line(gain, written=gain.motor in written) for gain in stored.gains]
    described = (whole := tomllib.loads(text)).get("controller", {})
    law = None if stored.law is UNSET or "structure" in described else stored.law
    if text and law is not None and law.controller is not None:
        keys = {key: value for key, value in law.controller.items() if key not in described}
        table = "".join(f"\n{key} = {json.dumps(value)}" for key, value in keys.items())
        header = r"(?m)^[ \t]*\[[ \t]*controller[ \t]*\].*$"  # also above nothing but remarks
        made, found = re.subn(header, rf"\g<0>{table}", text, count=1)
        text = checked_toml(
            made if found else f"{text}\n[controller]{table}\n",
            whole | {"controller": described | keys},
            place,
            "[controller]",
            "a line [controller], then a line per key",
        )
        lines.append(f"control law of the recording: {law.structure}")
    if lines:
        description = {**stored.description, "robot.toml": text}
        stored = msgspec.structs.replace(stored, description=description)
    return stored, lines


def _keys(gain: DriveGain) -> dict[str, object]:
    values: dict[str, object] = {"drive_gain_unit": gain.unit, "drive_gain": gain.value}
    return {"drive_gain_half_width": gain.half_width} | values if gain.half_width > 0 else values


def _gain_line(gain: DriveGain, *, written: bool) -> str:
    done = "as identified" if written else "as described"
    if not gain.determined:
        done += ", since none is described" * (gain.described is None) + "; not determined"
    return (
        f"drive gain of {gain.motor} {done}: {gain.value:.4g} ± {gain.half_width:.2g} {gain.unit}"
    )
