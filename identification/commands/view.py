"""`robot-identify view`: look at a recording that has not been fitted, in Rerun."""

import argparse
from pathlib import Path

from acquisition.commands import Commands, Progress, from_options

from ..errors import IdentificationError
from .options import add_recording, add_settings, refuse_outputs, sources
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
    if options.out and len(options.recordings) > 1:
        text = f"one file for {len(options.recordings)} recordings"
        raise IdentificationError(text, key="--out", value=str(options.out), expected="no --out: LOG.rrd each")
    outs = [options.out or Path(str(path).removesuffix(path.suffix) + ".rrd") for path in options.recordings]
    refuse_outputs([*options.recordings, options.robot], *outs)
    with Progress("reading") as progress:
        from ..regression import Overrides
        from ..view import write_recording_rrd

        for out, source in zip(outs, sources(options), strict=True):
            signals = source.load()
            progress.say("writing the Rerun file")
            write_recording_rrd(out, signals, from_options(Overrides, options))
    print_results(f"look at it: rerun --bind 127.0.0.1 {' '.join(map(str, outs))}")
