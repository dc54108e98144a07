"""`robot-acquire export`: joint samples as CSV."""

import argparse
import sys

from ..errors import one_line
from .command_line import Progress, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recording", "LOG.mcap", "the recording")
    add_path(parser, "-o --output", "OUT.csv", "the table to write", required=True)


def run(options: argparse.Namespace) -> None:
    """Write the table and print its size."""
    warnings: list[str] = []
    with Progress("exporting"):
        from ..files import refuse_clash
        from ..importing import export_csv

        refuse_clash([options.recording], of_kinds={"csv": options.output})
        rows = export_csv(options.recording, options.output, warnings.append)
    for text in dict.fromkeys(warnings):
        print(one_line(f"warning: {text}"), file=sys.stderr)
    print(one_line(f"{options.output}: {rows} rows"))
