"""`robot-acquire import`: a recording from tables (CSV, MAT), from a ROS 2 bag, or from a CAN log."""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from ..errors import AcquisitionError
from .command_line import Progress, add_overwrite, add_path
from .decode import print_imported


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    text = "CSV or MAT files, as the map counts them; or one ROS 2 bag (folder, .mcap, .db3); or one CAN log"
    add_path(inputs, "tables", "FILE", text, nargs="+")
    add_path(inputs, "--robot", "ROBOT.toml", "the robot's description", required=True)
    add_path(inputs, "--map", "MAP.toml", "which column is what: for tables alone")
    bag = parser.add_argument_group("ROS 2 bag")
    bag.add_argument("--topic", metavar="NAME", help="topic of sensor_msgs/msg/JointState, such as /joint_states")
    text = (
        "what effort is in the bag: 'N m' at the joints (a force in N where they slide), or A, V, ... of the motors; one "
        "for all, or one for each joint with commas between"
    )
    bag.add_argument("--effort-unit", metavar="UNIT", help=text)
    text = "rate to interpolate to (default: the roundest that stamps have)"
    bag.add_argument("--resample-hz", type=float, metavar="HZ", help=text)
    outputs = parser.add_argument_group("outputs")
    add_path(outputs, "-o --output", "LOG.mcap", "the recording to write", required=True)
    add_overwrite(outputs)


def run(options: argparse.Namespace) -> None:
    """Import a bag where a topic is given, tables where a map is, else a CAN log, and print what was imported."""
    from ..files import refuse_clash

    refuse_clash([options.robot, options.map, *options.tables], options.output, overwrite=options.overwrite)
    with Progress("importing"):
        from ..importing import import_bag, import_log, import_tables
        from ..robot import load_robot

        out, tables = options.output, options.tables
        if options.topic is not None:
            _refuse_as_bag(options)
            units = [unit.strip() for unit in options.effort_unit.split(",")]
            bag = {"topic": options.topic, "effort_unit": units, "resample_hz": options.resample_hz}
            found = import_bag(tables[0], load_robot(options.robot), out, **bag)
        else:
            _refuse_bag_options(options)
            if options.map is not None:
                found = import_tables(tables, load_robot(options.robot), options.map, out)
            else:
                _refuse_as_log(tables)
                found = import_log(tables[0], out, load_robot(options.robot), str(options.robot))
    print_imported(found, sys.stderr if options.topic is None and options.map is None else sys.stdout)


def _refuse_bag_options(options: argparse.Namespace) -> None:
    for name, value in (("--effort-unit", options.effort_unit), ("--resample-hz", options.resample_hz)):
        if value is not None:
            expected = "--topic with it; tables have time.resample_hz and effort.unit in MAP.toml"
            raise AcquisitionError("is of ROS 2 bags", key=name, value=value, expected=expected)


def _refuse_as_bag(options: argparse.Namespace) -> None:
    if options.map is not None:
        raise AcquisitionError("is for tables", key="--map", value=str(options.map), expected="none with --topic")
    if len(options.tables) > 1:
        raise AcquisitionError("a second bag", place=str(options.tables[1]), expected="one")
    if options.effort_unit is None:
        expected = "what the driver publishes, as its manual says: 'N m', A, ..."
        raise AcquisitionError("a bag does not say", key="--effort-unit", value=None, expected=expected)
    if options.resample_hz is not None and not 0 < options.resample_hz < math.inf:
        raise AcquisitionError(key="--resample-hz", value=options.resample_hz, expected="a number above 0")


def _refuse_as_log(paths: Sequence[Path]) -> None:
    from ..importing import is_bag, is_log

    tables = [path for path in paths if not is_log(path)]
    if tables and is_bag(tables[0]):
        expected = "the topic of its joint states, such as --topic /joint_states"
        raise AcquisitionError("a ROS 2 bag, and --topic is not there", place=str(tables[0]), expected=expected)
    if tables:
        expected = "MAP.toml, which says what its columns are; CAN logs end in .log, .asc, .blf or .trc"
        raise AcquisitionError("a table, and --map is not there", place=str(tables[0]), expected=expected)
    if len(paths) > 1:
        raise AcquisitionError("a second CAN log", place=str(paths[1]), expected="one")
