"""`robot-identify view`: draw a recording before a fit, or a fit that was stored."""

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
    inputs = parser.add_argument_group("inputs")
    add_recordings(inputs)
    add_path(
        inputs,
        "--log",
        "LOG.mcap",
        "with FIT.json in place of a recording: the recording to draw the fit on; without it the "
        "page has no curves",
    )
    add_options(parser.add_argument_group("settings of the fit"), Overrides, "cutoff_hz")
    add_path(
        parser.add_argument_group("outputs"),
        "-o --out",
        "VIEW.rrd",
        "file to write, with .html a page with spectra (default: LOG.rrd, or a viewer with "
        "--follow); of a fit also .md (default: FIT.html)",
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
    if options.recordings[0].suffix == ".json":
        return _fit(options)
    if options.log:
        raise BadInputError(
            "has no effect", key="--log", value=str(options.log), expected="FIT.json before it"
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


def _fit(options: argparse.Namespace) -> None:
    """Write the report of a stored fit, with its curves on the recording `--log`."""
    others = ("robot", "payload", "cutoff_hz", "follow", "fit")
    for name in others:
        if getattr(options, name):
            option = f"--{name.replace('_', '-')}"
            raise BadInputError("has no effect on a fit", place=option, expected="a recording")
    path, out = options.recordings[0], options.out
    out = out or path.with_suffix(".html")
    refuse_outputs([path, options.log], out)
    if out.suffix not in (".html", ".md", ".rrd"):
        raise BadInputError(key="--out", value=str(out), expected="FILE.html, FILE.md or FILE.rrd")
    if out.suffix == ".rrd" and options.log is None:
        raise BadInputError("has no curves", place=str(path), expected="--log LOG.mcap for a .rrd")
    with Progress("reading") as progress:
        from ..fits import Fit

        fit = Fit.read(path)
        progress.say("drawing")
        (fit.write_rrd if out.suffix == ".rrd" else fit.write_report)(out, options.log)
    how = "open the plots: rerun --bind 127.0.0.1" if out.suffix == ".rrd" else "open the report:"
    print_results(f"{how} {out}")


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
