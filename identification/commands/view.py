"""`robot-identify view`: draw a recording in Rerun, before a fit."""

import argparse
from pathlib import Path

from acquisition.commands import Progress, add_path, from_options

from ..errors import IdentificationError
from .arguments import add_recordings, add_settings, print_results, refuse_outputs, sources


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recordings(parser.add_argument_group("inputs"))
    add_settings(parser)
    outputs = parser.add_argument_group("outputs")
    add_path(outputs, "-o --out", "VIEW.rrd", "file to write (default: LOG.rrd)")


def run(options: argparse.Namespace) -> None:
    """Write the Rerun file, and print how to open it."""
    if options.out and len(options.recordings) > 1:
        text = f"one file for {len(options.recordings)} recordings"
        raise IdentificationError(text, key="--out", value=str(options.out), expected="no --out: LOG.rrd each")
    outs = [options.out or Path(str(path).removesuffix(path.suffix) + ".rrd") for path in options.recordings]
    refuse_outputs([*options.recordings, options.robot], *outs)
    with Progress("reading") as progress:
        from ..regression import Overrides
        from ..view import draw_recording, write_rrd

        for out, source in zip(outs, sources(options), strict=True):
            signals = source.load()
            progress.say("writing the Rerun file")
            write_rrd(out, draw_recording(signals, from_options(Overrides, options)))
    print_results(f"look at it: rerun --bind 127.0.0.1 {' '.join(map(str, outs))}")
