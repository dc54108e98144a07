"""`robot-acquire export`: joint samples as CSV, or as a ROS 2 bag."""

import argparse
import sys
from pathlib import Path

from ..errors import AcquisitionError, one_line
from .command_line import Commands, Progress


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("export", help="joint samples as CSV, or as a ROS 2 bag")
    parser.add_argument("recording", type=Path, metavar="LOG.mcap")
    outputs = parser.add_argument_group("outputs, one at least")
    outputs.add_argument("-o", "--output", type=Path, metavar="OUT.csv", help="the table to write")
    outputs.add_argument(
        "--bag", type=Path, metavar="FOLDER", help="the ROS 2 bag to write: joint states, and the URDF if there is one"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Write the table, the bag, or both, and print their sizes."""
    if options.output is None and options.bag is None:
        expected = "-o OUT.csv, --bag FOLDER or both"
        raise AcquisitionError("nothing to write", place=str(options.recording), expected=expected)
    lines: list[str] = []
    warnings: list[str] = []
    with Progress("exporting"):
        from ..files import refuse_clash
        from ..importing import export_bag, export_csv

        refuse_clash([options.recording], options.output, options.bag)
        if options.output is not None:
            lines.append(f"{options.output}: {export_csv(options.recording, options.output, warnings.append)} rows")
        if options.bag is not None:
            counts = export_bag(options.recording, options.bag, warnings.append)
            lines.append(f"{options.bag}: " + ", ".join(f"{count} of {topic}" for topic, count in counts.items()))
    for text in dict.fromkeys(warnings):
        print(one_line(f"warning: {text}"), file=sys.stderr)
    for line in lines:
        print(one_line(line))
