"""`robot-identify view`: look at a recording that has not been fitted, in Rerun."""

import argparse
from pathlib import Path

from acquisition.commands import Commands, Progress, from_options

from .options import add_recording, add_settings, load, refuse_outputs
from .results import print_results


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("view", help="look at a recording that has not been fitted, in Rerun")
    add_recording(parser)
    add_settings(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("-o", "--out", type=Path, metavar="VIEW.rrd", help="file to write (default: LOG.rrd)")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Write the Rerun file, and say how to open it."""
    out = options.out or Path(str(options.recording).removesuffix(options.recording.suffix) + ".rrd")
    refuse_outputs([options.recording, options.robot], out)
    with Progress("reading") as progress:
        from ..regression import Overrides
        from ..view import write_recording_rrd

        signals = load(options)
        progress.say("writing the Rerun file")
        write_recording_rrd(out, signals, from_options(Overrides, options))
    print_results(f"look at it: rerun --bind 127.0.0.1 {out}")
