"""Values in the tables of a description, such as its [[joint]]s, and those of a fit; all other
lines stay as they are.
"""

import json
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import msgspec
from msgspec import UNSET

from ..errors import BadInputError
from ..report import DriveGain, FitFile


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


def with_gains(stored: FitFile, place: str) -> tuple[FitFile, tuple[str, ...]]:
    """The fit with its drive gains in its description, and lines on them.

    A gain that is not determined is left as described; without a described one it is written with
    its wide interval. Raises `BadInputError` where a [[motor]] cannot be replaced line by line.
    """
    if stored.gains is UNSET or "robot.toml" not in stored.description:
        return stored, ()
    known = {
        gain.motor: _keys(gain)
        for gain in stored.gains
        if gain.determined or gain.described is None
    }
    text = replace_in_tables(
        stored.description["robot.toml"], "motor", known, f"the robot.toml in {place}"
    )
    lines = list[str]()
    for gain in stored.gains:
        done = "as identified" if gain.motor in known else "as described"
        if not gain.determined:
            done += ", since none is described" * (gain.described is None) + "; not determined"
        lines.append(
            f"drive gain of {gain.motor} {done}: {gain.value:.4g} ± {gain.half_width:.2g} "
            f"{gain.unit}"
        )
    return msgspec.structs.replace(
        stored, description={**stored.description, "robot.toml": text}
    ), tuple(lines)


def with_law(stored: FitFile, place: str) -> tuple[FitFile, tuple[str, ...]]:
    """The fit with the control law of its recording in its description, which has
    none, and a line on it.
    """
    text = stored.description.get("robot.toml", "")
    described = (whole := tomllib.loads(text)).get("controller", {})
    if not text or stored.law is UNSET or stored.law.controller is None or "structure" in described:
        return stored, ()
    keys = {key: value for key, value in stored.law.controller.items() if key not in described}
    lines = "".join(f"\n{key} = {json.dumps(value)}" for key, value in keys.items())
    header = r"(?m)^[ \t]*\[[ \t]*controller[ \t]*\].*$"  # also above nothing but remarks
    made, found = re.subn(header, rf"\g<0>{lines}", text, count=1)
    text = checked_toml(
        made if found else f"{text}\n[controller]{lines}\n",
        whole | {"controller": described | keys},
        f"the robot.toml in {place}",
        "[controller]",
        "a line [controller], then a line per key",
    )
    law = msgspec.structs.replace(stored, description={**stored.description, "robot.toml": text})
    return law, (f"control law of the recording: {stored.law.structure}",)


def _keys(gain: DriveGain) -> dict[str, object]:
    values: dict[str, object] = {"drive_gain_unit": gain.unit, "drive_gain": gain.value}
    return {"drive_gain_half_width": gain.half_width} | values if gain.half_width > 0 else values
