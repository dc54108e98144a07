"""A log of another program and its robot, made a recording with map and description beside it."""

import os
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from acquisition.errors import COMMAND_LINE, Location, one_line
from acquisition.files import is_recording, refuse_clash, write_text
from acquisition.importing import (
    EFFORT_UNITS,
    RAD_OR_DEG,
    TORQUE_SENSORS,
    BagOptions,
    complete_map,
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
from .chain import Chain, read_chain
from .description import describe, robot_of_chain

# Asks for an option, and shows the text before; None if the user does not know.
Ask = Callable[[str, str], Any]
MOST_QUESTIONS = 2
_OF_GAINS = ("A", "V", "%")  # efforts that a drive gain converts to N m or N
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
    *,
    overwrite: bool = False,
) -> Path:
    """Write the recording of a log, and its description and map, beside the log.

    A description or map that exists there is used.

    Parameters
    ----------
    log : CSV or MAT table, ROS 2 bag, CAN log or EtherCAT capture.
    robot : URDF, or robot.toml, which a CAN log needs.
    given : what the log does not contain.
    ask : function that asks the user for an option, at most twice; None without a user.
    say : function that receives lines on what was read, given or assumed, and warnings.
    overwrite : True to make recording, description and map anew.

    Returns
    -------
    The recording.

    Raises
    ------
    BadInputError : a file cannot be read, something is not known and nobody can be asked, the
        recording exists, or an option differs from a file.
    """
    place = Location(str(log))
    place.require(
        is_bag(log) or not is_recording(log),
        text="a recording contains its description",
        advice=f"Run `robot-identify fit {log}`, with --robot for another robot.toml",
    )
    stem = log.with_suffix("") if log.is_file() else log
    out = stem.with_name(f"{stem.name}{'_recording' * (log.suffix == '.mcap')}.mcap")
    Location(str(out)).require(
        overwrite or not out.exists(),
        text="the recording of this log already exists",
        advice=f"Run `robot-identify fit {out}`, or make it anew",
        arguments=("overwrite",),
    )
    described, map_path = (stem.with_name(f"{stem.name}.{x}.toml") for x in ("robot", "map"))
    is_urdf = robot.suffix.lower() != ".toml"
    keep_robot, keep_map = (x.exists() and not overwrite for x in (described, map_path))
    chain = read_chain(robot) if is_urdf and not keep_robot else None
    refuse_clash(
        [log, robot], described if chain else None, overwrite=overwrite, of_kinds={"mcap": out}
    )
    source = described if is_urdf else robot
    known = load_robot(source) if chain is None else robot_of_chain(chain)
    _refuse_known(given, source if chain is None else None, map_path if keep_map else None)
    if is_log(log):
        place.require(
            not is_urdf,
            text="a log of a bus needs its drives",
            advice="Pass a robot.toml with [bus]",
        )
        found = import_log(log, out, known, str(robot))
    else:
        text = map_path.read_text(encoding="utf-8") if keep_map else ""
        if not keep_map:
            given, text = _complete(log, known, given, ask, chain is not None)
        if chain is not None:
            chain = _with_efforts(chain, given, text)
            write_text(described, describe(chain, os.path.relpath(robot, described.parent)))
            known = load_robot(described)
        say(f"{source}: {_robot_line(known)}")
        if is_bag(log):
            options = BagOptions(effort_unit=given.effort_unit or (), topic=given.topic or "")
            found = import_bag(log, known, out, options)
        else:
            if not keep_map:
                write_text(map_path, text)
            say(f"{map_path}:")
            for line in _map_lines(text):
                say(f"  {one_line(line)}")
            found = import_tables([log], known, map_path, out)
    for line in summary_lines(found):
        say(line)
    for text in found.warnings:
        say(one_line(f"warning: {text}"))
    return out


def _refuse_known(given: LogOptions, described: Path | None, map_path: Path | None) -> None:
    """Refuse options of which a file that is used has the values."""
    for path, names in (
        (described, ("ratio", "drive_gain")),
        (map_path, ("columns", "position_unit", "effort_unit")),
    ):
        for name in names if path else ():
            COMMAND_LINE.require(
                getattr(given, name) is None,
                name,
                text=f"{path} is used, which gives it",
                advice="Edit that file, or omit the option",
            )


def _complete(
    log: Path, robot: Robot, given: LogOptions, ask: Ask | None, of_urdf: bool
) -> tuple[LogOptions, str]:
    """Return what the log does not contain, from `given` or asked for, and the map of a table."""
    questions, text = 0, ""
    while True:
        missing = [] if given.effort_unit else ["effort_unit"]
        if not is_bag(log):
            columns, rate_hz = split_columns(given.columns) if given.columns else ({}, None)
            text, units = propose_map(log, robot, columns), {}
            if ask and RAD_OR_DEG in text:
                units["position_unit"] = ["rad"], "assumed, because all values are within 2 pi"
            for name in ("position_unit", "effort_unit"):
                if values := getattr(given, name):
                    units[name] = values, "as given"
            text, missing = complete_map(text, units, rate_hz, robot)
        if not (missing or given.drive_gain) and {*_OF_GAINS} & {*_effort_units(given, text)}:
            missing = ["drive_gain"] * of_urdf
        name = missing[0] if missing else ""
        asked = ask is not None and questions < MOST_QUESTIONS
        if not name or (name == "drive_gain" and not asked):
            return given, text
        answer = ask(name, text) if ask and asked and getattr(given, name) is None else None
        if answer is None and name != "drive_gain":
            _refuse_open(log, text, missing)
        given, questions = replace(given, **{name: answer}), questions + 1
        if answer is None:
            return given, text


def _refuse_open(log: Path, text: str, missing: Sequence[str]) -> NoReturn:
    why = re.findall(rf'(?m)^[^#\n]*"{FILL_IN}".*# (.*)$', text)
    Location(str(log)).refuse(
        text=f"does not show {' and '.join(_OPEN[x] for x in missing)}"
        + f" ({'; '.join(dict.fromkeys(why))})" * bool(why),
        advice="Look them up in the manual, and add",
        arguments=missing,
    )


def _effort_units(given: LogOptions, text: str) -> list[str]:
    """Return the SI units of the efforts, one or one per joint."""
    units = tomllib.loads(text)["effort"]["unit"] if text else given.effort_unit or ()
    return [
        EFFORT_UNITS[x][0] if x in EFFORT_UNITS else x
        for x in ([units] if isinstance(units, str) else units)
    ]


def _with_efforts(chain: Chain, given: LogOptions, text: str) -> Chain:
    """Return the chain with the units of the efforts, the gains and the ratios."""
    units = _effort_units(given, text)
    joints = tuple(
        replace(joint, effort_unit="N" if unit == "N m" and joint.type == "prismatic" else unit)
        for joint, unit in zip(chain.joints, units * len(chain.joints), strict=False)
    )
    values = {"ratio": given.ratio, "drive_gain": given.drive_gain}
    if given.drive_gain and not given.ratio:
        values["ratio"] = (1.0,)  # the gain is then that at the joint
    return replace(chain, joints=joints, torque_sensors=TORQUE_SENSORS in text).with_values(
        {name: value for name, value in values.items() if value}
    )


def _robot_line(robot: Robot) -> str:
    """Describe the joints and what their efforts are."""
    units = dict.fromkeys(motor.recorded_unit for motor in robot.motors)
    gains = [f"{motor.drive_gain:g}" for motor in robot.motors if motor.drive_gain]
    told = f", drive gains {', '.join(gains)} {robot.motors[0].drive_gain_unit}" * bool(gains)
    return one_line(f"{robot.n} joints of {robot.name}, efforts in {', '.join(units)}{told}")


def _map_lines(text: str) -> Iterator[str]:
    """Return a line for each table of a map: its columns, unit and side, with the reasons."""
    yield from re.findall(r"(?m)^# (no \[.*)$", text)
    for table, content in re.findall(r"(?m)^\[(\w+)\]\n((?:[^\[\n].*\n)*)", text):
        values, reasons = zip(*re.findall(r"(?m)^\w+ = (.*?)(?: # (.*))?$", content), strict=True)
        ends = [
            names[:: len(names) - 1 or 1] for x in values for names in [x.strip("[]").split(", ")]
        ]
        shown = ", ".join(" to ".join(names).replace('"', "") for names in ends)
        yield f"{table}: {shown} ({'; '.join(dict.fromkeys(filter(None, reasons)))})"
