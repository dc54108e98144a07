"""`robot-acquire export`: joint samples as CSV."""

import argparse
from pathlib import Path

from ..errors import one_line
from .command_line import Commands, Progress


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("export", help="joint samples as CSV")
    parser.add_argument("recording", type=Path, metavar="LOG.mcap")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="OUT.csv", help="the table to write")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Write the table, and print its number of rows."""
    with Progress("exporting"):
        from ..files import refuse_clash
        from ..importing import export_csv

        refuse_clash([options.recording], options.output)
        rows = export_csv(options.recording, options.output)
    print(one_line(f"{options.output}: {rows} rows"))
