"""`robot-identify fit`: base parameters from a recording, or from several of one robot."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from acquisition.commands import Commands, Progress, from_options

from ..errors import IdentificationError
from .options import (
    above_zero,
    add_method,
    add_recording,
    add_settings,
    add_work,
    positive,
    refuse_outputs,
    sources,
    work_of,
)
from .results import print_results, untrusted

if TYPE_CHECKING:
    from ..data import Recordings
    from ..methods import Fit, Prior


def add(commands: Commands) -> None:
    """Declare the command; its settings have the names of the fields of `Overrides` and `Iteration`."""
    parser = commands.add_parser("fit", help="base parameters from a recording, or from several")
    add_recording(parser)
    settings = add_settings(parser)
    add_method(settings)
    settings.add_argument(
        "--essential", action="store_true", help="keep only the parameters the recording determines well"
    )
    consistent = parser.add_argument_group("physically consistent parameters")
    consistent.add_argument(
        "--consistent", action="store_true", help="also give all standard parameters, as a physical robot can have them"
    )
    consistent.add_argument(
        "--prior",
        type=Path,
        metavar="ROBOT.toml|URDF",
        help="links expected: those of its [parameters] or its URDF (default: those of the recording's description)",
    )
    iv = parser.add_argument_group("settings of instrumental variables")
    iv.add_argument(
        "--start",
        metavar="regular|ls|FIT.json",
        help="first parameters: unit inertias (default), least squares, or those of a fit's JSON file",
    )
    iv.add_argument(
        "--tolerance-percent", type=above_zero, metavar="P", help="passes end when changes are smaller (default 2.5)"
    )
    iv.add_argument("--max-iterations", type=positive, metavar="N", help="most passes (default 10)")
    add_work(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("--require", choices=["trust"], help="exit status 3 where the verdict is less, for scripts")
    outputs.add_argument("--all", action="store_true", help="print all parameters, not only the essential ones")
    outputs.add_argument("--json", type=Path, metavar="FILE", help="write the fit as JSON")
    outputs.add_argument(
        "--report", type=Path, metavar="FILE", help="write the printed report; its ending names the format: .md, .html"
    )
    outputs.add_argument("--rrd", type=Path, metavar="FILE", help="write trajectories and fit as a Rerun file")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Fit, write what is asked for, print the tables; 3 when the fit is not to be trusted."""
    for name in ("start", "tolerance_percent", "max_iterations"):
        if options.method in ("ols", "wls") and getattr(options, name) is not None:
            raise IdentificationError(
                f"does nothing with --method {options.method}",
                key=f"--{name.replace('_', '-')}",
                value=getattr(options, name),
                expected="--method iv with it",
            )
    if options.prior is not None and not options.consistent:
        expected = "--consistent with it"
        raise IdentificationError("does nothing alone", key="--prior", value=str(options.prior), expected=expected)
    inputs = [*options.recordings, options.robot, options.prior, Path(options.start or "regular")]
    refuse_outputs(inputs, options.json, options.report, picture=options.rrd)
    from acquisition.files import refuse_clash

    pictures = [options.rrd] if options.rrd else []
    if len(options.recordings) > 1 and options.rrd:
        pictures = [options.rrd.with_stem(f"{options.rrd.stem}_{path.stem}") for path in options.recordings]
        refuse_clash(inputs, *pictures)
    with Progress("reading") as progress:
        from ..data import Recordings
        from ..methods import fit_document, fit_file
        from ..report import check_report_file, write_json, write_report

        if options.report:
            check_report_file(options.report)
        with work_of(options, len(options.recordings)) as work:
            recordings = Recordings(sources=tuple(sources(options)), work=work)
            prior = _prior(options) if options.consistent else None
            fit = _identify(options, recordings, progress.say)
        if prior is not None:
            from ..methods import with_consistent

            fit = with_consistent(fit, prior)
    signals = fit.problem.signals
    document = fit_document(signals, fit, everything=options.all)
    try:
        if options.json:
            write_json(options.json, fit_file(fit))
        if options.report:
            write_report(options.report, document)
        for picture, one in zip(pictures, fit.recordings, strict=False):
            with Progress("writing the Rerun file"):
                from ..view import write_fit_rrd

                write_fit_rrd(picture, one.problem.signals, fit.on(one))
    finally:  # print the fit even if a file cannot be written
        print_results(document)
    verdict, reasons = fit.trust.verdict, fit.distrust
    if options.require and not reasons and verdict != options.require:
        reasons = tuple(line.text for line in fit.trust.lines if line.level == verdict)
    return untrusted(reasons)


def _prior(options: argparse.Namespace) -> "Prior":
    """What `--prior` expects of the links; before any fit, so that a recording in A or V is refused at once."""
    from acquisition.robot import load_robot

    from ..methods import Prior, refuse_unknown_gain, urdf_prior

    path = options.prior
    robot = sources(options)[0].load().robot
    refuse_unknown_gain(robot)
    if path is None:
        return Prior()
    if path.suffix.lower() == ".toml":
        return Prior(robot=load_robot(path), name=path.name)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise IdentificationError(f"cannot be read: {error}", place=str(path)) from error
    return Prior(robot=urdf_prior(robot, text, path.name), name=path.name)


def _identify(options: argparse.Namespace, recordings: "Recordings", say: Callable[[str], None]) -> "Fit":
    from ..methods import Iteration, identify, stored_beta
    from ..regression import Overrides
    from ..report import read_fit

    overrides = from_options(Overrides, options)
    iteration = None
    if any(getattr(options, name) is not None for name in ("start", "tolerance_percent", "max_iterations")):
        values = None
        if options.start not in (None, "regular", "ls"):
            values = partial(stored_beta, read_fit(Path(options.start)), place=options.start)
        iteration = from_options(Iteration, options, values=values)
    return identify(
        recordings, overrides, method=options.method, iteration=iteration, essential=options.essential, say=say
    )
