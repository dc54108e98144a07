"""`robot-identify compare`: the parameters of two fits, or of a fit and a prior."""

import argparse
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from acquisition.commands import add_flag, add_path
from acquisition.errors import COMMAND_LINE

from ..options import Overrides
from .arguments import add_pictures, refuse_outputs, show_results

if TYPE_CHECKING:
    from ..report import FitFile

NO_LOGS = (
    "Torques are not drawn: the recordings of both fits are not beside them. Add --log LOG.mcap, "
    "or one LOG.mcap for each fit."
)


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "a", "A.json", "fit that `fit --json` wrote")
    add_path(
        parser,
        "b",
        "B.json|URDF",
        "another fit; or a URDF or robot.toml with a priori link parameters",
    )
    add_path(
        parser,
        "--log",
        "LOG.mcap",
        "recording for the torques, one for both fits or one each (default: their own, if they "
        "are beside the fits); requires --rrd or an HTML report",
        nargs="+",
        default=[],
    )
    add_path(parser, "--json", "FILE", "write the comparison as JSON")
    add_flag(parser, "--all", "print all parameters, not only the largest differences")
    add_pictures(parser, "write parameters and torques of both fits as a Rerun file")


def run(options: argparse.Namespace) -> None:
    """Print the differences, and the warnings of both fits."""
    from ..report import ParameterSet, comparison_document, differences, frame_lines, read_fit

    paths, prior = (options.a, options.b), options.b.suffix.lower() in (".urdf", ".toml")
    refuse_outputs(
        [*paths, *options.log], json=options.json, report=options.report, picture=options.rrd
    )
    drawn = not prior and (options.rrd or (options.report and options.report.suffix == ".html"))
    COMMAND_LINE.require(
        not options.log or (drawn and len(options.log) < 3),
        "--log",
        " ".join(map(str, options.log)),
        "one or two recordings of two fits, with --rrd or --report FILE.html",
    )
    if prior or drawn:
        from .. import data, results

    first = read_fit(options.a)
    second = results.prior_file(first, str(options.a), options.b) if prior else read_fit(options.b)
    names = [str(path) if options.a.stem == options.b.stem else path.stem for path in paths]
    a, b = ParameterSet.of_file(first, names[0]), ParameterSet.of_file(second, names[1])
    logs = (options.log * 2)[:2] or (_own_logs((first, second), paths) if drawn else [])
    document = comparison_document(
        a,
        b,
        (
            *first.warnings_of(str(options.a)),
            *second.warnings_of(str(options.b)),
            *frame_lines(first, second, (a.label, b.label)),
        ),
        prior=prior,
    )
    digests = {str(path): sha256(path.read_bytes()).hexdigest() for path in paths}
    show_results(
        options,
        document,
        lambda: {"a": a.label, "b": b.label, "differences": differences(a, b)},
        lambda view: [
            view.draw_comparison(
                a,
                b,
                document,
                digests,
                [
                    one
                    for fit, path, log in zip((first, second), paths, logs, strict=False)
                    for one in results.predict_recordings(
                        fit, str(path), [(data.load_signals(log), log)], Overrides(), ahead=False
                    )[0]
                ],
            )
        ],
        [options.rrd] if options.rrd else [],
        [
            *([NO_LOGS] if drawn and not logs else []),
            *([f"Plots: rerun --bind 127.0.0.1 {options.rrd}"] if options.rrd else []),
        ],
    )


def _own_logs(fits: Sequence["FitFile"], paths: Sequence[Path]) -> list[Path]:
    """Return a recording of each fit: the first that both have, or the first of each.

    A recording counts if it is beside its fit and has the same content; without one for each fit
    the list is empty.
    """
    found = [
        {
            one.sha256: log
            for one in fit.recordings or filter(None, [fit.provenance])
            if (log := path.parent / one.recording).is_file()
            if sha256(log.read_bytes()).hexdigest() == one.sha256
        }
        for fit, path in zip(fits, paths, strict=True)
    ]
    common = [digest for digest in found[0] if digest in found[1]]
    return [own[(common or list(own))[0]] for own in found] if all(found) else []
