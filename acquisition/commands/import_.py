"""`robot-acquire import`: convert tables, bags, logs, captures or recordings to a recording."""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from ..errors import COMMAND_LINE, Location, one_line
from ..options import RecordOptions
from .command_line import Progress, add_options, add_overwrite, add_path

if TYPE_CHECKING:
    from ..importing import ImportSummary
    from ..robot import Robot


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(
        inputs,
        "tables",
        "FILE",
        "CSV or MAT files in the order of their numbers in the map; or one ROS 2 bag (folder, "
        ".mcap, .db3), CAN log (.log of candump, .asc, .blf, .trc), EtherCAT capture (.pcap, "
        ".pcapng) or recording, which is decoded again, and repaired if it is truncated",
        nargs="+",
    )
    add_path(inputs, "--robot", "ROBOT.toml", "robot description (a recording contains its own)")
    add_path(
        inputs,
        "--map",
        "MAP.toml",
        "meaning of the columns (default: FILE.map.toml, proposed if it does not exist)",
    )
    add_options(inputs, RecordOptions, "payload")
    bag = parser.add_argument_group("ROS 2 bag")
    bag.add_argument(
        "--topic",
        metavar="NAME",
        help="topic of type JointState, then after a comma one of type "
        "JointTrajectoryControllerState (default: the only ones)",
    )
    bag.add_argument(
        "--effort-unit",
        metavar="UNIT",
        help="unit of the efforts: 'N m' at the joints (N if prismatic), or A, V, ... at the "
        "motors; one for all joints, or one per joint separated by commas; required for a bag",
    )
    bag.add_argument(
        "--resample-hz",
        type=float,
        metavar="HZ",
        help="sample rate in Hz to interpolate to (default: rounded rate of the timestamps)",
    )
    parser.add_argument_group("EtherCAT capture").add_argument(
        "--mapping",
        metavar="0x6041:16,0x6064:32,...",
        action="append",
        default=[],
        help="PDO inputs of one slave, for captures that start after the bus was configured; "
        "write gaps as 0:BITS; repeat in bus order",
    )
    outputs = parser.add_argument_group("outputs")
    add_path(
        outputs,
        "-o --output",
        "LOG.mcap",
        "recording to write (default: name of the first FILE)",
    )
    add_overwrite(outputs)


def run(options: argparse.Namespace) -> None:
    """Import the files, and print a summary."""
    from ..files import refuse_clash

    options.output = options.output or options.tables[0].with_suffix(".mcap")
    refuse_clash(
        [options.robot, options.map, *options.tables],
        overwrite=options.overwrite,
        of_kinds={"mcap": options.output},
    )
    with Progress("importing"):
        from ..importing import is_bag

        bag = options.topic is not None or (options.map is None and is_bag(options.tables[0]))
        found = _imported(options, bag)
    if found is not None:
        _print(found, sys.stdout if bag or options.map is not None else sys.stderr)


def _imported(options: argparse.Namespace, bag: bool) -> "ImportSummary | None":
    """Import by the kind of the first file.

    The result is None if the user must complete a map first.
    """
    from ..files import is_recording
    from ..importing import (
        BagOptions,
        import_bag,
        import_log,
        import_recording,
        import_tables,
        is_log,
    )
    from ..robot import load_robot, parse_payload

    out, tables = options.output, options.tables
    if options.mapping and (options.topic or options.map or not is_log(tables[0])):
        COMMAND_LINE.refuse(
            "--mapping",
            options.mapping[0],
            text="this option is only for EtherCAT captures",
            advice="Remove it",
        )
    robot = None if options.robot is None else load_robot(options.robot)
    payload = (
        None if options.payload is None or robot is None else parse_payload(options.payload, robot)
    )
    if not bag and options.map is None and is_recording(tables[0]):
        _refuse_bag_options(options)
        _refuse_second(tables, "recording")
        COMMAND_LINE.require(
            options.payload is None,
            "--payload",
            options.payload,
            text="a recording keeps its own payload",
            advice="Remove the option; `robot-identify fit --payload` replaces the payload",
        )
        return import_recording(tables[0], out, robot, str(options.robot or ""))
    if not bag and options.map is None and _propose(options, robot):
        return None
    robot = COMMAND_LINE.given(
        robot,
        "--robot",
        None,
        text="only recordings contain a robot description",
        advice="Pass --robot ROBOT.toml",
    )
    if bag:
        _refuse_as_bag(options)
        topic, _, other = (name.strip() for name in (options.topic or "").partition(","))
        return import_bag(
            tables[0],
            robot,
            out,
            BagOptions(
                topic=topic,
                reference_topic=other,
                effort_unit=[unit.strip() for unit in options.effort_unit.split(",")],
                resample_hz=options.resample_hz,
            ),
            payload,
        )
    _refuse_bag_options(options)
    if options.map is not None:
        return import_tables(tables, robot, options.map, out, payload)
    _refuse_as_log(tables)
    return import_log(tables[0], out, robot, str(options.robot), payload, options.mapping)


def _print(found: "ImportSummary", warnings: TextIO) -> None:
    from ..importing import summary_lines

    print(*summary_lines(found), sep="\n")
    for text in found.warnings:
        print(one_line(f"warning: {text}"), file=warnings)


def _propose(options: argparse.Namespace, robot: "Robot | None") -> bool:
    """Use the map of a single table, and propose one if it does not exist.

    The result is True if the user must complete it, or has no robot description.
    """
    from ..files import write_text
    from ..importing import TORQUE_SENSORS, is_log, lines_to_fill_in, propose_map

    table: Path = options.tables[0]
    if len(options.tables) > 1 or is_log(table):
        return False
    options.map = table.with_suffix(".map.toml")
    if options.map.exists():
        return False
    text = propose_map(table, robot)
    write_text(options.map, text)
    missing, sensors = lines_to_fill_in(text.encode()), TORQUE_SENSORS in text
    print(
        one_line(
            f"{options.map}: proposed; "
            f"{f'complete its lines {missing}' if missing else 'nothing is missing'}"
        )
    )
    if robot is not None and sensors and any(joint.rotor_inertia for joint in robot.joints):
        print(
            one_line(
                f"note: {TORQUE_SENSORS} do not measure the rotors: set rotor_inertia = false in "
                f"{options.robot}"
            )
        )
    if robot is None:
        effort = (
            '"N m" --torque-sensor'
            if sensors
            else "A --ratio R --drive-gain K"
            if '"A"' in text
            else "UNIT"
        )
        print(f"without a robot.toml: robot-identify init ARM.urdf --effort {effort} -o robot.toml")
    if robot is None or missing:
        print(
            one_line(
                f"next: robot-acquire import {table} --robot {options.robot or 'robot.toml'} "
                f"-o {options.output}"
            )
        )
    return robot is None or bool(missing)


def _refuse_bag_options(options: argparse.Namespace) -> None:
    for name, value in (
        ("--effort-unit", options.effort_unit),
        ("--resample-hz", options.resample_hz),
    ):
        COMMAND_LINE.require(
            value is None,
            name,
            value,
            text="this option is only for ROS 2 bags",
            advice="For tables, set time.resample_hz and effort.unit in MAP.toml",
        )


def _refuse_as_bag(options: argparse.Namespace) -> None:
    COMMAND_LINE.require(
        options.map is None,
        "--map",
        str(options.map),
        text="this option is only for tables, not for bags",
        advice="Remove it",
    )
    _refuse_second(options.tables, "bag")
    COMMAND_LINE.require(
        options.effort_unit is not None,
        "--effort-unit",
        None,
        text="a bag does not contain the unit",
        advice="Pass the unit that the driver's manual gives, such as 'N m' or A",
    )
    COMMAND_LINE.require(
        options.resample_hz is None or 0 < options.resample_hz < math.inf,
        "--resample-hz",
        options.resample_hz,
        "a finite number greater than 0",
    )


def _refuse_as_log(paths: Sequence[Path]) -> None:
    from ..importing import is_log

    for path in paths:
        Location(str(path)).require(
            is_log(path),
            text="a table needs a map of its columns",
            advice="Pass --map MAP.toml, or import a CAN log (.log, .asc, .blf, .trc)",
        )
    _refuse_second(paths, "CAN log")


def _refuse_second(paths: Sequence[Path], kind: str) -> None:
    for path in paths[1:]:
        Location(str(path)).refuse(
            text=f"only one {kind} can be imported at a time", advice="Import this one separately"
        )
