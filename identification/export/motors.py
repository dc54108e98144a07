"""Identified drive gains in the description of a fit: keys of its [[motor]] tables; all other lines stay."""

import json
import re
import tomllib

import msgspec
from msgspec import UNSET

from ..errors import IdentificationError
from ..report import DriveGain, FitFile

_MOTOR = re.compile(r"(?m)^([ \t]*\[\[[ \t]*motor[ \t]*\]\][ \t]*(?:#.*)?)$")


def with_gains(stored: FitFile, place: str) -> tuple[FitFile, tuple[str, ...]]:
    """The fit with its drive gains in its description, and lines on them.

    A gain that is not determined is left as described; without a described one it is written with its wide interval. Raises
    `IdentificationError` where a [[motor]] cannot be replaced line by line.
    """
    if stored.gains is UNSET or "robot.toml" not in stored.description:
        return stored, ()
    known = {gain.motor: gain for gain in stored.gains if gain.determined or gain.described is None}
    text, lines = replace_gains(stored.description["robot.toml"], known, place), list[str]()
    for gain in stored.gains:
        done = "as identified" if gain.motor in known else "as described"
        if not gain.determined:
            done += ", since none is described" * (gain.described is None) + "; not determined"
        lines.append(f"drive gain of {gain.motor} {done}: {gain.value:.4g} ± {gain.half_width:.2g} {gain.unit}")
    return msgspec.structs.replace(stored, description={**stored.description, "robot.toml": text}), tuple(lines)


def replace_gains(text: str, gains: dict[str, DriveGain], place: str) -> str:
    """A description with `drive_gain`, its unit and half-width in the [[motor]] tables of these names; all other lines stay.

    Raises `IdentificationError` where a table is not found, or not written with one key a line.
    """
    now, written = tomllib.loads(text), set()
    made, *tables = _MOTOR.split(text)  # headers and what follows them
    for motor, header, table in zip(now["motor"], tables[::2], tables[1::2], strict=False):
        if (gain := gains.get(motor["name"])) is not None:
            values = {"drive_gain_unit": gain.unit, "drive_gain": gain.value}
            if gain.half_width > 0:
                values = {"drive_gain_half_width": gain.half_width} | values
            motor |= values
            written.add(motor["name"])
            for key, value in values.items():
                shown = json.dumps(value)
                line = re.compile(rf"(?m)^([ \t]*{key}[ \t]*=[ \t]*)[^#\n]*?([ \t]*(?:#.*)?)$")
                table, found = line.subn(rf"\g<1>{shown}\g<2>", table, count=1)
                if not found:  # after the first key
                    table = re.sub(r"^\n[^\n]*", rf"\g<0>\n{key} = {shown}", table)
        made += header + table
    if written != gains.keys() or tomllib.loads(made) != now:
        problem, expected = (
            "drive gains cannot be replaced line by line",
            "a line [[motor]] of each, then a line per key",
        )
        raise IdentificationError(problem, place=f"the robot.toml in {place}", key="[[motor]]", expected=expected)
    return made
