"""`robot-acquire import`: a recording from tables (CSV, MAT) or from a CAN log."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import AcquisitionError, one_line
from .command_line import Commands, Progress
from .decode import print_converted

if TYPE_CHECKING:
    from ..importing import Imported


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "import", help="tables (CSV, MAT) or CAN logs (candump, ASC, BLF, TRC) into a recording"
    )
    inputs = parser.add_argument_group("inputs")
    inputs.add_argument(
        "tables", nargs="+", type=Path, metavar="FILE", help="CSV or MAT files, as the map counts them; or one CAN log"
    )
    inputs.add_argument("--robot", required=True, type=Path, metavar="ROBOT.toml", help="the robot's description")
    inputs.add_argument(
        "--map", type=Path, metavar="MAP.toml", help="which column is what: for tables, none for CAN logs"
    )
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("-o", "--output", required=True, type=Path, metavar="LOG.mcap", help="the recording to write")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Import tables, or a CAN log where no map is given, and print what was imported."""
    if options.map is None:
        _import_log(options)
        return
    with Progress("importing"):
        from ..files import refuse_clash
        from ..importing import import_tables
        from ..robot import load_robot

        refuse_clash([options.robot, options.map, *options.tables], options.output)
        result = import_tables(options.tables, load_robot(options.robot), options.map, options.output)
    _print_imported(result)


def _print_imported(result: "Imported") -> None:
    units = ", ".join(dict.fromkeys(result.effort_units))
    also = "".join(
        f", with {name.replace('_', ' ')}" for name in (["reference"] if result.has_reference else []) + [*result.optional]
    )
    rate = f"{result.samples} samples at {result.sample_rate_hz:g} Hz"
    print(one_line(f"{result.out}: {result.robot}, {rate}, effort in {units}{also}"))
    if result.times:
        print(one_line(f"times: {result.times}"))
    for text in result.warnings:
        print(one_line(f"warning: {text}"))


def _import_log(options: argparse.Namespace) -> None:
    with Progress("importing"):
        from ..files import refuse_clash
        from ..importing import import_log, is_log
        from ..robot import load_robot

        tables = [path for path in options.tables if not is_log(path)]
        if tables:
            expected = "MAP.toml, which says what its columns are; CAN logs end in .log, .asc, .blf or .trc"
            raise AcquisitionError("a table, and --map is not there", place=str(tables[0]), expected=expected)
        if len(options.tables) > 1:
            raise AcquisitionError("a second CAN log", place=str(options.tables[1]), expected="one")
        refuse_clash([options.robot, *options.tables], options.output)
        found = import_log(options.tables[0], options.output, load_robot(options.robot), str(options.robot))
    print_converted(options.output, found)
