"""`robot-acquire info`: what a recording holds."""

import argparse
import sys
from pathlib import Path

from .command_line import Commands, Progress


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("info", help="what a recording holds")
    parser.add_argument("recording", type=Path, metavar="LOG.mcap")
    parser.add_argument("--json", action="store_true", help="as JSON, for programs")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print the recording's overview."""
    with Progress("reading"):
        from ..importing import row_doubts
        from ..recording import as_tables, overview, read_recording

        recording = read_recording(options.recording)
        found = overview(recording, row_doubts(recording))
    if options.json:
        import msgspec

        print(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    else:
        from rich.console import Console

        # A pipe has no width of its own: lines are not to be broken there.
        Console(width=None if sys.stdout.isatty() else 500).print(as_tables(found))
