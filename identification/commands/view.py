"""`robot-identify view`: draw a recording before a fit, or a fit that was stored."""

import argparse
import os
import sys
from pathlib import Path

from acquisition.commands import Progress, add_flag, add_options, add_path, from_options
from acquisition.errors import COMMAND_LINE, Location

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
        "recording to draw a fit on, which else has no curves; requires FIT.json in place of "
        "LOG.mcap",
    )
    add_options(parser.add_argument_group("settings of the fit"), Overrides, "cutoff_hz")
    add_path(
        parser.add_argument_group("outputs"),
        "-o --out",
        "VIEW.rrd",
        "file to write: .rrd, .html with spectra, of a fit also .md (default: LOG.rrd, or "
        "FIT.html; with --follow a viewer)",
    )
    live = parser.add_argument_group("while another terminal records")
    add_flag(
        live,
        "--follow",
        "show the recording while it is written; the live view cannot stop the robot",
    )
    add_path(
        live, "--fit", "FIT.json", "also show the residual torque of this fit; requires --follow"
    )


def run(options: argparse.Namespace) -> None:
    """Write the Rerun file or the page, and print how to open it."""
    COMMAND_LINE.require(
        options.out is None or len(options.recordings) == 1,
        "--out",
        str(options.out),
        text=f"one file cannot show {len(options.recordings)} recordings",
        advice="Omit --out: each LOG.mcap gets its LOG.rrd",
    )
    if options.recordings[0].suffix == ".json":
        return _fit(options)
    for option, value, required in (
        ("--log", options.log, "FIT.json in place of the recording"),
        ("--fit", None if options.follow else options.fit, "--follow"),
    ):
        COMMAND_LINE.require(value is None, option, str(value), text=f"requires {required}")
    is_page = options.out is not None and options.out.suffix == ".html"
    if options.follow:
        COMMAND_LINE.require(not is_page, "--out", str(options.out), "FILE.rrd with --follow")
        return _follow(options)
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
    for name in ("robot", "payload", "cutoff_hz", "follow", "fit"):
        Location(f"--{name.replace('_', '-')}").require(
            not getattr(options, name), text="requires a recording in place of the fit"
        )
    path = options.recordings[0]
    out = options.out or path.with_suffix(".html")
    refuse_outputs([path, options.log], out)
    COMMAND_LINE.require(
        out.suffix in (".html", ".md", ".rrd"),
        "--out",
        str(out),
        "FILE.html, FILE.md or FILE.rrd",
    )
    Location(str(path)).require(
        options.log or out.suffix != ".rrd",
        text="a fit that was read has no curves to draw in a .rrd",
        advice="Add --log LOG.mcap",
    )
    with Progress("reading") as progress:
        from ..fits import load

        fit = load(path)
        progress.say("drawing")
        (fit.write_rrd if out.suffix == ".rrd" else fit.write_report)(out, options.log)
    how = "open the plots: rerun --bind 127.0.0.1" if out.suffix == ".rrd" else "open the report:"
    print_results(f"{how} {out}")


def _follow(options: argparse.Namespace) -> None:
    """Show one recording while it is written, with a low priority: the recorder comes first."""
    os.nice(10)  # before the imports, which take a second of a core
    from ..view import follow_recording

    path, *others = options.recordings
    COMMAND_LINE.require(not others, "--follow", len(options.recordings), "one recording")
    refuse_outputs([path, options.fit], rrd=options.out)
    follow_recording(
        path,
        options.fit,
        options.out,
        lambda text: print(f"warning: {text}", file=sys.stderr, flush=True),
    )
    print_results(f"{path}: the recording has ended and is complete")
