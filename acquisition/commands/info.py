"""`robot-acquire info`: the contents of a recording."""

import argparse
import sys

from .command_line import Progress, add_flag, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recording", "LOG.mcap", "the recording")
    add_flag(parser, "--json", "print JSON, for programs")


def run(options: argparse.Namespace) -> None:
    """Print the recording's overview."""
    with Progress("reading"):
        from ..recording import as_tables, overview, read_recording

        found = overview(read_recording(options.recording))
    if options.json:
        import msgspec

        print(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    else:
        from rich.console import Console

        # Do not break lines in a pipe, which has no width; without trailing blanks, since one long
        # line pads all others.
        console = Console(width=None if sys.stdout.isatty() else 500)
        with console.capture() as shown:
            console.print(as_tables(found))
        print(*(line.rstrip() for line in shown.get().splitlines()), sep="\n")
