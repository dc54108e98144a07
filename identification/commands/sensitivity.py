"""`robot-identify sensitivity`: how LS and IV depend on filter, decimation, position noise,
start and gain update.
"""

import argparse
from hashlib import sha256

from acquisition.commands import Progress, add_flag, add_path

from ..options import list_of_values
from .arguments import (
    add_report,
    add_work,
    print_results,
    refuse_outputs,
    sources,
    work_of,
    write_pictures,
)


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recordings", "LOG.mcap", "the recording", nargs=1)
    add_path(parser, "--robot", "ROBOT.toml", "use this description instead of the recording's own")
    parser.add_argument(
        "--position-noise",
        type=list_of_values,
        metavar="A,B",
        help="white noise to add to the recorded position, rad or m rms (default: by the travel)",
    )
    add_flag(parser, "--all", "also print the values and intervals of all fits")
    add_report(parser)
    add_work(parser)


def run(options: argparse.Namespace) -> None:
    """Fit the recording in all variants, and print how far the estimates move."""
    refuse_outputs([*options.recordings, options.robot], report=options.report)
    with Progress("fitting"):
        from ..study import sensitivity_document, vary

        fits = vary(
            sources(options)[0],
            options.position_noise,
            work_of(options, len(options.position_noise or "abc") + 9),
        )
        document = sensitivity_document(options.recordings[0].name, fits)
    try:
        (path,) = options.recordings
        digests = {path.name: sha256(path.read_bytes()).hexdigest()}
        write_pictures(
            options, document, lambda view: [view.draw_sensitivity(digests, fits, document)]
        )
    finally:  # print the result even if a file cannot be written
        print_results(document, everything=options.all)
