"""`robot-identify view`: draw a recording in Rerun, before a fit."""

import argparse
import os
import sys
from pathlib import Path

from acquisition.commands import Progress, add_flag, add_options, add_path, from_options

from ..errors import BadInputError
from ..options import Overrides
from .arguments import add_recordings, print_results, refuse_outputs, sources


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recordings(parser.add_argument_group("inputs"))
    add_options(parser.add_argument_group("settings of the fit"), Overrides, "cutoff_hz")
    add_path(
        parser.add_argument_group("outputs"),
        "-o --out",
        "VIEW.rrd",
        "file to write, with .html a page with spectra (default: LOG.rrd, or a viewer with "
        "--follow)",
    )
    live = parser.add_argument_group("while another terminal records")
    add_flag(
        live,
        "--follow",
        "show the recording while it is written; only a picture, it does not stop the robot",
    )
    add_path(live, "--fit", "FIT.json", "with --follow: also the residual torque of this fit")


def run(options: argparse.Namespace) -> None:
    """Write the Rerun file or the page, and print how to open it."""
    if options.out and len(options.recordings) > 1:
        raise BadInputError(
            f"one file for {len(options.recordings)} recordings",
            key="--out",
            value=str(options.out),
            expected="no --out: LOG.rrd each",
        )
    is_page = options.out is not None and options.out.suffix == ".html"
    if options.follow and is_page:
        raise BadInputError(key="--out", value=str(options.out), expected="FILE.rrd with --follow")
    if options.follow:
        return _follow(options)
    if options.fit:
        raise BadInputError(
            "has no effect", key="--fit", value=str(options.fit), expected="--follow with it"
        )
    outs = [
        options.out or Path(str(path).removesuffix(path.suffix) + ".rrd")
        for path in options.recordings
    ]
    refuse_outputs([*options.recordings, options.robot], *outs)
    with Progress("reading") as progress:
        from ..view import draw_recording, write_html, write_rrd

        for out, source in zip(outs, sources(options), strict=True):
            signals = source.load()
            progress.say("drawing")
            (write_html if is_page else write_rrd)(
                out, draw_recording(signals, from_options(Overrides, options))
            )
    names = " ".join(map(str, outs))
    print_results(
        f"open the report: {names} in a browser"
        if is_page
        else f"open the plots: rerun --bind 127.0.0.1 {names}"
    )


def _follow(options: argparse.Namespace) -> None:
    """Show one recording while it is written, with a low priority: the recorder comes first."""
    os.nice(10)  # before the imports, which take a second of a core
    from ..view import follow_recording

    if len(options.recordings) > 1:
        raise BadInputError(key="--follow", value=len(options.recordings), expected="one recording")
    refuse_outputs([*options.recordings, options.fit], rrd=options.out)
    (path,) = options.recordings
    follow_recording(
        path,
        options.fit,
        options.out,
        lambda text: print(f"warning: {text}", file=sys.stderr, flush=True),
    )
    print_results(f"{path}: the recording has ended and is whole")
