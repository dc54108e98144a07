"""`robot-acquire info`: show what a recording contains, and export its joint samples as CSV."""

import argparse
import sys

from ..errors import one_line
from .command_line import Progress, add_flag, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recording", "LOG.mcap", "recording to show")
    add_flag(parser, "--json", "print JSON for other programs")
    add_path(parser, "--csv", "OUT.csv", "write the joint samples to this table")


def run(options: argparse.Namespace) -> None:
    """Print the overview of the recording. Write the table and print its size."""
    warnings: list[str] = []
    size = ""
    with Progress("reading"):
        from ..files import refuse_clash
        from ..importing import export_csv
        from ..recording import as_tables, overview, read_recording

        if options.csv is not None:
            refuse_clash([options.recording], of_kinds={"csv": options.csv})
            rows = export_csv(options.recording, options.csv, warnings.append)
            size = one_line(f"{options.csv}: {rows} rows")
        found = overview(read_recording(options.recording))
    if options.json:
        import msgspec

        print(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    else:
        from rich.console import Console

        # Lines are not broken in a pipe, which has no width. Trailing blanks are removed, because
        # one long line pads all others.
        console = Console(width=None if sys.stdout.isatty() else 500)
        with console.capture() as shown:
            console.print(as_tables(found))
        print(*(line.rstrip() for line in shown.get().splitlines()), sep="\n")
    for text in warnings:
        print(one_line(f"warning: {text}"), file=sys.stderr)
    if size:
        # Standard output must contain only the JSON.
        print(size, file=sys.stderr if options.json else sys.stdout)
