"""`robot-acquire export`: joint samples as CSV or as a ROS 2 bag."""

import argparse
import sys

from ..errors import AcquisitionError, one_line
from .command_line import Progress, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recording", "LOG.mcap", "the recording")
    outputs = parser.add_argument_group("outputs, at least one")
    add_path(outputs, "-o --output", "OUT.csv", "the table to write")
    add_path(outputs, "--bag", "FOLDER", "the ROS 2 bag to write: joint states, and the URDF if there is one")


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
