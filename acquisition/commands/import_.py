"""`robot-acquire import`: a recording from tables (CSV, MAT), from a ROS 2 bag, or from a CAN log."""

import argparse
import math
import sys
from typing import TYPE_CHECKING

from ..errors import AcquisitionError
from .command_line import Progress, add_overwrite, add_path
from .decode import print_imported

if TYPE_CHECKING:
    from ..importing import Imported


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(
        inputs,
        "tables",
        "FILE",
        "CSV or MAT files, as the map counts them; or one ROS 2 bag (folder, .mcap, .db3); or one CAN log",
        nargs="+",
    )
    add_path(inputs, "--robot", "ROBOT.toml", "the robot's description", required=True)
    add_path(inputs, "--map", "MAP.toml", "which column is what: for tables alone")
    bag = parser.add_argument_group("ROS 2 bag")
    bag.add_argument("--topic", metavar="NAME", help="topic of sensor_msgs/msg/JointState, such as /joint_states")
    bag.add_argument(
        "--effort-unit",
        metavar="UNIT",
        help="what effort is in the bag: 'N m' at the joints (a force in N where they slide), or A, V, ... of the motors; one "
        "for all, or one for each joint with commas between",
    )
    bag.add_argument(
        "--resample-hz",
        type=float,
        metavar="HZ",
        help="rate to interpolate to (default: the roundest that stamps have)",
    )
    outputs = parser.add_argument_group("outputs")
    add_path(outputs, "-o --output", "LOG.mcap", "the recording to write", required=True)
    add_overwrite(outputs)


def run(options: argparse.Namespace) -> None:
    """Import a bag where a topic is given, tables where a map is, else a CAN log, and print what was imported."""
    from ..files import refuse_clash

    refuse_clash([options.robot, options.map, *options.tables], options.output, overwrite=options.overwrite)
    with Progress("importing"):
        if options.topic is not None:
            found = _bag(options)
        else:
            _refuse_bag_options(options)
            found = _log(options) if options.map is None else _tables(options)
    print_imported(found, sys.stderr if options.topic is None and options.map is None else sys.stdout)


def _refuse_bag_options(options: argparse.Namespace) -> None:
    for name, value in (("--effort-unit", options.effort_unit), ("--resample-hz", options.resample_hz)):
        if value is not None:
            expected = "--topic with it; tables have time.resample_hz and effort.unit in MAP.toml"
            raise AcquisitionError("is of ROS 2 bags", key=name, value=value, expected=expected)


def _bag(options: argparse.Namespace) -> "Imported":
    from ..importing import import_bag
    from ..robot import load_robot

    if options.map is not None:
        raise AcquisitionError("is for tables", key="--map", value=str(options.map), expected="none with --topic")
    if len(options.tables) > 1:
        raise AcquisitionError("a second bag", place=str(options.tables[1]), expected="one")
    if options.effort_unit is None:
        expected = "what the driver publishes, as its manual says: 'N m', A, ..."
        raise AcquisitionError("a bag does not say", key="--effort-unit", value=None, expected=expected)
    if options.resample_hz is not None and not 0 < options.resample_hz < math.inf:
        raise AcquisitionError(key="--resample-hz", value=options.resample_hz, expected="a number above 0")
    return import_bag(
        options.tables[0],
        load_robot(options.robot),
        options.output,
        topic=options.topic,
        effort_unit=[unit.strip() for unit in options.effort_unit.split(",")],
        resample_hz=options.resample_hz,
    )


def _tables(options: argparse.Namespace) -> "Imported":
    from ..importing import import_tables
    from ..robot import load_robot

    return import_tables(options.tables, load_robot(options.robot), options.map, options.output)


def _log(options: argparse.Namespace) -> "Imported":
    from ..importing import import_log, is_bag, is_log
    from ..robot import load_robot

    tables = [path for path in options.tables if not is_log(path)]
    if tables and is_bag(tables[0]):
        expected = "the topic of its joint states, such as --topic /joint_states"
        raise AcquisitionError("a ROS 2 bag, and --topic is not there", place=str(tables[0]), expected=expected)
    if tables:
        expected = "MAP.toml, which says what its columns are; CAN logs end in .log, .asc, .blf or .trc"
        raise AcquisitionError("a table, and --map is not there", place=str(tables[0]), expected=expected)
    if len(options.tables) > 1:
        raise AcquisitionError("a second CAN log", place=str(options.tables[1]), expected="one")
    return import_log(options.tables[0], options.output, load_robot(options.robot), str(options.robot))
