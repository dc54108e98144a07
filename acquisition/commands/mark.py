"""`robot-acquire mark`: add a note to the recording in progress."""

import argparse

from .command_line import add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recording", "LOG.mcap", "the recording in progress")
    parser.add_argument(
        "text", metavar="TEXT", help="the note; it is stored as an event, with the time"
    )


def run(options: argparse.Namespace) -> None:
    """Note the text for the recorder."""
    from ..recording import add_mark

    add_mark(options.recording, options.text)
