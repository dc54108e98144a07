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
from ..report import Document, Section
from .chain import read_chain
from .description import OF_GAINS, describe, read_robot, robot_of_chain

# Asks for an option, with the map so far, until the value passes the check; None if the user does
# not know it.
Ask = Callable[[str, str, Callable[[Any], object]], Any]
MOST_QUESTIONS = 2
_OPEN = {
    "columns": "which columns are positions and efforts, or the sample rate",
    "position_unit": "the unit of the positions",
    "effort_unit": "the unit of the efforts",
}


def import_foreign_log(
    log: Path,
    robot: Path,
    given: LogOptions,
    ask: Ask | None = None,
) -> tuple[Path, Document]:
    """Write the recording of a log, and its description and map, beside the log.

    Parameters
    ----------
    log : CSV or MAT table, ROS 2 bag, CAN log or EtherCAT capture.
    robot : URDF, or robot.toml, which a CAN log needs.
    given : what the log does not contain.
    ask : function that asks the user for an option, at most twice; None without a user.

    Returns
    -------
    The recording, and a report of what was written, read, given and assumed, with warnings.

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
            advice=f"Run `robot-identify fit {out}`, or import the log again",
            arguments=("overwrite",),
        )
    gains = {"ratio": given.ratio, "drive_gain": given.drive_gain}
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
        values = {
            # Without a ratio, a gain is that at the joint.
            "ratio": given.ratio or (given.drive_gain and (1.0,)),
            "drive_gain": given.drive_gain,
            "torque_sensor": TORQUE_SENSORS in text,
        }
        chain = chain.with_efforts(
            chain.units_of(_effort_units(given, text)),
            {name: x for name, x in values.items() if x},
        )
        write_text(described, describe(chain, os.path.relpath(robot, described.parent)))
        known = load_robot(described)
    if text:
        write_text(map_path, text)
        found = import_tables([log], known, map_path, out)
    elif bag:
        units = [effort_unit(unit) for unit in given.effort_unit or ()]
        found = import_bag(log, known, out, BagOptions(effort_unit=units, topic=given.topic or ""))
    else:
        found = import_log(log, out, known, str(robot))
    title, *others = summary_lines(found)
    files = [str(described)] * is_urdf + [str(map_path)] * bool(text)
    lines = (
        ("robot", _robot_line(known)),
        *_map_lines(text),
        *((label, line) for label, _, line in (line.partition(": ") for line in others)),
        ("also written", ", ".join(files)),
    )
    shown = tuple(line for line in lines if line[1])
    return out, Document(title=title, sections=(Section(lines=shown, warnings=found.warnings),))


def _complete(
    log: Path, robot: Robot, given: LogOptions, ask: Ask | None, *, bag: bool, of_urdf: bool
) -> tuple[LogOptions, str]:
    """Return what the log does not contain, from `given` or asked for, and the map of a table."""
    _, missing = _map(log, robot, given, bag=bag)
    # With more open than may be asked, the most likely unit is assumed, and this is printed.
    assume = ask is not None and len(missing) > MOST_QUESTIONS
    for left in range(MOST_QUESTIONS, -1, -1):
        text, missing = _map(log, robot, given, bag=bag, assume=assume)
        optional = of_urdf and not given.drive_gain and {*_effort_units(given, text)} & {*OF_GAINS}
        if not missing and not (optional and ask and left):
            break
        name = missing[0] if missing else "drive_gain"

        def check(value: Any, name: str = name, given: LogOptions = given) -> None:
            tried = replace(given, **{name: value})
            _, still = _map(log, robot, tried, bag=bag, assume=True)
            Location(str(log)).require(
                name not in still, text=f"{value} does not show {_OPEN.get(name)}"
            )

        answer = ask(name, text, check) if ask and left else None
        if answer is None:
            break
        given = replace(given, **{name: answer})
    why = dict.fromkeys(re.findall(rf'(?m)^[^#\n]*"{FILL_IN}".*# (.*)$', text))
    Location(str(log)).require(
        not missing,
        text=f"does not show {', '.join(_OPEN[x] for x in missing)}"
        + f" ({'; '.join(why)})" * bool(why),
        advice="Look in the manual of the robot or its driver, and give these options",
        arguments=missing,
    )
    return given, text


def _map(
    log: Path, robot: Robot, given: LogOptions, *, bag: bool, assume: bool = False
) -> tuple[str, list[str]]:
    """Return the map of a table, and the options that the log still needs."""
    efforts = [effort_unit(unit) for unit in given.effort_unit or ()]
    if bag:
        return "", [] if efforts else ["effort_unit"]
    columns, rate_hz = split_columns(given.columns) if given.columns else ({}, None)
    text = propose_map(log, robot, columns)
    known = {"position_unit": given.position_unit, "effort_unit": efforts}
    units = {name: (values, "as given") for name, values in known.items() if values}
    if assume and RAD_OR_DEG in text:
        units.setdefault("position_unit", (("rad",), "assumed, because all values are within 2 pi"))
    return complete_map(
        text,
        units,
        rate_hz,
        geared=given.ratio is not None or not np.array_equal(robot.R, np.eye(robot.n)),
    )


def _effort_units(given: LogOptions, text: str) -> list[str]:
    """Return the SI units of the efforts, one or one per joint; none while they are not known."""
    units = tomllib.loads(text)["effort"]["unit"] if text else given.effort_unit or ()
    known = [effort_unit(x) for x in ([units] if isinstance(units, str) else units) if x != FILL_IN]
    return [EFFORT_UNITS[x][0] for x in known]


def _robot_line(robot: Robot) -> str:
    """Describe the joints and what their efforts are."""
    units = dict.fromkeys(motor.recorded_unit for motor in robot.motors)
    gains = [f"{motor.drive_gain:g}" for motor in robot.motors if motor.drive_gain]
    told = f", drive gains {', '.join(gains)} {robot.motors[0].drive_gain_unit}" * bool(gains)
    return one_line(f"{robot.n} joints of {robot.name}, efforts in {', '.join(units)}{told}")


def _map_lines(text: str) -> Iterator[tuple[str, str]]:
    """Return for each table of a map its columns, unit and side, with the reasons."""
    for table, content in re.findall(r"(?m)^\[(\w+)\]\n((?:[^\[\n].*\n)*)", text):
        values, reasons = zip(*re.findall(r"(?m)^\w+ = (.*?)(?: # (.*))?$", content), strict=True)
        names = [value.strip("[]").replace('"', "").split(", ") for value in values]
        shown = ", ".join(" to ".join(x[:: len(x) - 1 or 1]) for x in names)
        why = dict.fromkeys(re.sub("from the names.*", "by name", x) for x in reasons if x)
        yield table, f"{shown} ({'; '.join(why)})"
    yield from (("no reference", x) for x in re.findall(r"(?m)^# no \[reference\]: (.*)$", text))
