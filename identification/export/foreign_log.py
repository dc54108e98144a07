"""A log of another program and its robot, made a recording with map and description beside it."""

import os
import re
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.errors import Location, one_line
from acquisition.files import is_recording, write_text
from acquisition.importing import (
    EFFORT_UNITS,
    RAD_OR_DEG,
    TORQUE_SENSORS,
    BagOptions,
    complete_map,
    effort_unit,
    import_bag,
    import_log,
    import_tables,
    is_bag,
    is_log,
    propose_map,
    split_columns,
    summary_lines,
)
from acquisition.robot import FILL_IN, Robot, load_robot

from ..options import LogOptions
from .chain import read_chain
from .description import OF_GAINS, describe, read_robot, robot_of_chain

# Asks for an option, and shows the text before; None if the user does not know.
Ask = Callable[[str, str], Any]
MOST_QUESTIONS = 2
_OPEN = {
    "columns": "the quantities of its columns, or its sample rate",
    "position_unit": "the unit of the positions",
    "effort_unit": "the unit of the efforts",
}


def import_foreign_log(
    log: Path,
    robot: Path,
    given: LogOptions,
    ask: Ask | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Path:
    """Write the recording of a log, and its description and map, beside the log.

    Parameters
    ----------
    log : CSV or MAT table, ROS 2 bag, CAN log or EtherCAT capture.
    robot : URDF, or robot.toml, which a CAN log needs.
    given : what the log does not contain.
    ask : function that asks the user for an option, at most twice; None without a user.
    say : function that receives lines on what was read, given or assumed, and warnings.

    Returns
    -------
    The recording.

    Raises
    ------
    BadInputError : a file cannot be read, something is not known and nobody can be asked, a file
        to be written exists, or an option differs from what the log shows.
    """
    place, bag, is_urdf = Location(str(log)), is_bag(log), robot.suffix.lower() != ".toml"
    place.require(
        bag or not is_recording(log),
        text="a recording contains its description",
        advice=f"Run `robot-identify fit {log}`, with --robot for another robot.toml",
    )
    stem = log.with_suffix("") if log.is_file() else log
    described = stem.with_name(f"{stem.name}.robot.toml") if is_urdf else robot
    map_path = stem.with_name(f"{stem.name}.map.toml")
    out = stem.with_name(f"{stem.name}{'_recording' * (log.suffix == '.mcap')}.mcap")
    for path in (out, map_path, *[described] * is_urdf):
        Location(str(path)).require(
            given.overwrite or not path.exists(),
            text="already exists",
            advice=f"Run `robot-identify fit {out}`, after `robot-acquire import {log} --robot "
            f"{described}` for an edited map, or make all files anew",
            arguments=("overwrite",),
        )
    gains: dict[str, Any] = {"ratio": given.ratio, "drive_gain": given.drive_gain}
    chain, text = read_chain(robot) if is_urdf else None, ""
    known = (
        robot_of_chain(chain)
        if chain
        else read_robot(robot, given={name: x for name, x in gains.items() if x})
    )
    if is_log(log):
        place.require(
            chain is None,
            text="a log of a bus needs its drives",
            advice="Pass a robot.toml with [bus]",
        )
    else:
        given, text = _complete(log, known, given, ask, bag=bag, of_urdf=is_urdf)
    if chain is not None:
        # Without a ratio, a gain is that at the joint.
        ratio = given.ratio or (given.drive_gain and (1.0,))
        gains |= {"torque_sensor": TORQUE_SENSORS in text, "ratio": ratio}
        chain = chain.with_efforts(
            chain.units_of(_effort_units(given, text)),
            {name: values for name, values in gains.items() if values},
        )
        write_text(described, describe(chain, os.path.relpath(robot, described.parent)))
        known = load_robot(described)
    say(f"{described}: {_robot_line(known)}")
    if text:
        write_text(map_path, text)
        for line in (f"{map_path}:", *_map_lines(text)):
            say(line)
        found = import_tables([log], known, map_path, out)
    elif bag:
        options = BagOptions(effort_unit=given.effort_unit or (), topic=given.topic or "")
        found = import_bag(log, known, out, options)
    else:
        found = import_log(log, out, known, str(robot))
    for line in (*summary_lines(found), *(f"warning: {text}" for text in found.warnings)):
        say(one_line(line))
    return out


def _complete(
    log: Path, robot: Robot, given: LogOptions, ask: Ask | None, *, bag: bool, of_urdf: bool
) -> tuple[LogOptions, str]:
    """Return what the log does not contain, from `given` or asked for, and the map of a table."""
    text, assume = "", ask is not None
    for left in range(MOST_QUESTIONS, -1, -1):
        if given.effort_unit:
            given = replace(given, effort_unit=tuple(map(effort_unit, given.effort_unit)))
        ask, missing = ask if left else None, [] if given.effort_unit else ["effort_unit"]
        if not bag:
            text, missing = _map(log, robot, given, assume=assume)
        if not missing:
            current = {*_effort_units(given, text)} & {*OF_GAINS}
            if current and of_urdf and ask and not given.drive_gain:
                given = replace(given, drive_gain=ask("drive_gain", text))
            break
        (name, *_), why = missing, re.findall(rf'(?m)^[^#\n]*"{FILL_IN}".*# (.*)$', text)
        answer = ask(name, text) if ask and getattr(given, name) is None else None
        if answer is None:
            Location(str(log)).refuse(
                text=f"does not show {' and '.join(_OPEN[x] for x in missing)}"
                + f" ({'; '.join(dict.fromkeys(why))})" * bool(why),
                advice="Look them up in the manual, and add",
                arguments=missing,
            )
        given = replace(given, **{name: answer})
    return given, text


def _map(log: Path, robot: Robot, given: LogOptions, *, assume: bool) -> tuple[str, list[str]]:
    """Return the map of a table, and the options that it still needs."""
    columns, rate_hz = split_columns(given.columns) if given.columns else ({}, None)
    text = propose_map(log, robot, columns)
    known = {"position_unit": given.position_unit, "effort_unit": given.effort_unit}
    units = {name: (values, "as given") for name, values in known.items() if values}
    if assume and RAD_OR_DEG in text:
        units.setdefault("position_unit", (("rad",), "assumed, because all values are within 2 pi"))
    geared = given.ratio is not None or not np.array_equal(robot.R, np.eye(robot.n))
    return complete_map(text, units, rate_hz, geared=geared)


def _effort_units(given: LogOptions, text: str) -> list[str]:
    """Return the SI units of the efforts, one or one per joint."""
    units = tomllib.loads(text)["effort"]["unit"] if text else given.effort_unit or ()
    return [EFFORT_UNITS[x][0] for x in ([units] if isinstance(units, str) else units)]


def _robot_line(robot: Robot) -> str:
    """Describe the joints and what their efforts are."""
    units = dict.fromkeys(motor.recorded_unit for motor in robot.motors)
    gains = [f"{motor.drive_gain:g}" for motor in robot.motors if motor.drive_gain]
    told = f", drive gains {', '.join(gains)} {robot.motors[0].drive_gain_unit}" * bool(gains)
    return one_line(f"{robot.n} joints of {robot.name}, efforts in {', '.join(units)}{told}")


def _map_lines(text: str) -> Iterator[str]:
    """Return a line for each table of a map: its columns, unit and side, with the reasons."""
    yield from re.findall(r"(?m)^#( no \[.*)$", text)
    for table, content in re.findall(r"(?m)^\[(\w+)\]\n((?:[^\[\n].*\n)*)", text):
        values, reasons = zip(*re.findall(r"(?m)^\w+ = (.*?)(?: # (.*))?$", content), strict=True)
        ends = [
            names[:: len(names) - 1 or 1] for x in values for names in [x.strip("[]").split(", ")]
        ]
        shown = ", ".join(" to ".join(names).replace('"', "") for names in ends)
        yield f"  {table}: {shown} ({'; '.join(dict.fromkeys(filter(None, reasons)))})"
