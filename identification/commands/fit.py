"""`robot-identify fit`: base parameters from one or more recordings of one robot."""

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from acquisition.commands import Progress, add_flag, add_options, add_path, from_options

from ..errors import BadInputError
from ..options import LogOptions, Overrides, ReferenceOptions
from . import arguments as shared

if TYPE_CHECKING:
    from .. import results


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    shared.add_recordings(
        parser.add_argument_group("inputs"),
        "one or more recordings of one robot; or a log (CSV, MAT, ROS 2 bag, CAN log) and its "
        "ROBOT.urdf or robot.toml, from which LOG.mcap is made",
    )
    log = parser.add_argument_group("what a log does not contain; a terminal asks for it")
    add_options(log, LogOptions)
    settings = parser.add_argument_group("settings of the fit")
    add_options(settings, Overrides, "cutoff_hz", "torque_lag_s")
    shared.add_method(settings)
    add_options(settings, Overrides, "gains")
    add_flag(settings, "--essential", "fit only the essential (well-determined) parameters")
    consistent = parser.add_argument_group("physically consistent parameters")
    add_flag(
        consistent,
        "--consistent",
        "also compute physically consistent standard parameters of all links",
    )
    add_path(
        consistent,
        "--prior",
        "ROBOT.toml|URDF",
        "a priori link parameters, from [parameters] or a URDF (default: the recorded "
        "description); requires --consistent",
    )
    settings.add_argument(
        "--start",
        metavar="ls|regular|FIT.json",
        help="initial parameters: ls (least squares), regular (unit inertias), or those of a fit "
        "(default: ls); requires iv",
    )
    shared.add_work(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument(
        "--require", choices=["trust"], help="exit with status 3 unless the verdict is `trust`"
    )
    add_flag(outputs, "--all", "print everything: all parameters, tests, iterations, settings")
    add_flag(
        outputs,
        "--brief",
        "print only the verdict, and the `excite` command for the parameters that are not well "
        "determined",
    )
    add_path(outputs, "--json", "FILE", "write the fit as JSON")
    add_path(
        outputs,
        "--write-corrected",
        "ROBOT.toml",
        "if tests name wrong signs, zeros or gains, write the corrected description, and fit with "
        "it; `record --track` refuses it until a person has confirmed the joints",
    )
    shared.add_pictures(
        outputs,
        "write trajectories and fit as a Rerun file; for several recordings FILE_LOG.rrd each",
    )


def run(options: argparse.Namespace) -> int:
    """Fit, write the requested files, print the tables; 3 if the fit is not to be trusted."""
    shared.COMMAND_LINE.require(
        options.start is None or options.method not in ("ols", "wls"),
        "--start",
        options.start,
        text=f"requires --method iv, not {options.method}",
    )
    shared.COMMAND_LINE.require(
        options.prior is None or options.consistent,
        "--prior",
        str(options.prior),
        text="requires --consistent",
    )
    shared.COMMAND_LINE.require(
        options.write_corrected is None or not options.write_corrected.exists(),
        "--write-corrected",
        str(options.write_corrected),
        text="the file already exists",
        advice="Choose a new name",
    )
    robots = (".urdf", ".xml", ".xacro", ".toml")
    if len(options.recordings) > 1 and options.recordings[-1].suffix.lower() in robots:
        options.recordings = [_recording_of_log(options)]
    pictures = _pictures(options)
    with Progress("reading") as progress:
        from .. import report, results

        fit, corrected = _corrected(options, progress.say)
    document = results.fit_document(file := results.fit_file(fit, corrected))
    poor = [p.name for p in file.parameters if not p.essential]
    shared.show_results(
        options,
        document.with_short(
            document.sections[bool(corrected)].title,
            *([("Corrected", "; ".join(corrected))] if corrected else []),
            (
                "Findings",
                ", ".join(x.test for x in fit.trust.lines if x.level in ("do not use", "caution")),
            ),
            (
                "Torque error",
                f"{report.Number(file.moving_relative_error_percent, '.3g').text} % in motion",
            ),
            ("Parameters", f"{file.size - len(poor)} of {file.size} well determined"),
            ("The others", report.by_joint(poor, [joint.name for joint in file.joints])),
        )
        if options.brief
        else document,
        lambda: file,
        lambda view: [view.draw_fit(file, one) for one in fit.recordings],
        pictures,
    )
    shared.print_results(
        *(
            _next_step(fit, poor, options)
            if options.brief
            else [
                f"Report: {options.report}"
                if options.report
                else f"Report with charts: add --report {options.recordings[0].stem}.html",
                *(
                    [f"Plots: rerun --bind 127.0.0.1 {' '.join(map(str, pictures))}"]
                    if pictures
                    else []
                ),
                *([] if options.robot else edited_descriptions(fit, options.recordings)),
            ]
        )
    )
    refused = ("do not use", "caution") if options.require else ("do not use",)
    return shared.trust_status(
        [
            f"{line.text}. {line.advice}".removesuffix(". ")
            for line in fit.trust.lines
            if line.level == fit.trust.lines[0].level in refused
        ]
    )


def _recording_of_log(options: argparse.Namespace) -> Path:
    """Make the recording of a log, and ask on a terminal for what it does not contain."""
    from ..export import import_foreign_log

    log, *others = options.recordings
    shared.COMMAND_LINE.require(
        len(others) == 1, "LOG", len(options.recordings), "one log, then its robot"
    )
    terminal = sys.stdin.isatty() and sys.stdout.isatty()
    given = from_options(LogOptions, options)
    recording, document = import_foreign_log(log, others[0], given, _ask if terminal else None)
    shared.print_results(document, "", everything=False)
    return recording


def _ask(name: str, text: str, check: Callable[[Any], object]) -> Any:
    """Ask for the value of an option until it passes the check; None for an empty line."""
    from ..report import Document

    how = get_args(get_type_hints(LogOptions, include_extras=True)[name])[1]
    columns = [line[1:] for line in text.splitlines() if line.startswith("#   ")]
    shared.print_results(*columns * (name == "columns"))
    shared.print_results(Document(title=how["help"].replace("%%", "%"), sections=()))
    with suppress(EOFError):
        while True:
            optional = ", Enter: not known" * (name == "drive_gain")
            print(f"{name.replace('_', ' ')} [{how['metavar']}{optional}]", end=": ", flush=True)
            if not (answer := input()):
                break
            try:
                check(value := how["type"](answer))
                return value
            except (argparse.ArgumentTypeError, BadInputError) as error:
                shared.print_results(str(error))
    return None


def _next_step(
    fit: "results.Evidence", poor: Sequence[str], options: argparse.Namespace
) -> list[str]:
    """Return what would determine the `poor` parameters: a sentence, the command of a reference.

    The reference must be expected to halve an interval, so that the advice ends where the true
    values are 0. Nothing is advised for data that must not be used.
    """
    from ..design import expected_after

    if not poor or fit.trust.verdict == "do not use":
        return []
    (log, *_), robot = options.recordings, options.robot or Path("robot.toml")
    try:
        period_s, shares = expected_after(fit, robot)
    except BadInputError as error:
        return [f"No reference can be designed to narrow their intervals. {error}"]
    # The same motion again would leave a share of 0.71.
    times = [1 / share for name, share in shares.items() if name in poor and share < 0.5]
    return (
        [
            f"One more recording should narrow {len(times)} of their intervals, up to "
            f"{max(times):.3g} times:",
            shlex.join(
                [
                    *("robot-identify", "excite", str(robot)),
                    *("--after", *map(str, options.recordings)),
                    *(
                        ["--period", f"{period_s:g}"]
                        if period_s != ReferenceOptions.period_s
                        else []
                    ),
                    *("-o", str(log.with_name(f"{log.stem}_next.csv"))),
                ]
            ),
        ]
        if times
        else ["To narrow their intervals, estimate the delay first: fit with --method iv."]
        if any(line.test == "delay" and line.level == "caution" for line in fit.trust.lines)
        else ["One more recording would not halve their intervals: their values may be 0."]
    )


def _pictures(options: argparse.Namespace) -> list[Path]:
    """Return the Rerun files to write, one for each recording.

    Outputs that cannot be written are refused.
    """
    from acquisition.files import refuse_clash

    inputs = [*options.recordings, options.robot, options.prior, Path(options.start or "ls")]
    shared.refuse_outputs(
        inputs,
        json=options.json,
        report=options.report,
        picture=options.rrd,
        corrected=options.write_corrected,
    )
    several = len(options.recordings) > 1
    pictures = [
        options.rrd.with_stem(f"{options.rrd.stem}_{path.stem}") if several else options.rrd
        for path in options.recordings
        if options.rrd
    ]
    refuse_clash(inputs, *pictures)
    return pictures


def edited_descriptions(fit: "results.Evidence", recordings: list[Path]) -> list[str]:
    """Return a line for each robot.toml that differs from the recording's own.

    Such files are beside a recording or in the working folder.
    """
    lines = dict[str, None]()
    for one, path in zip(fit.recordings, recordings, strict=True):
        robot = one.problem.signals.robot
        for beside in (path.parent / "robot.toml", Path("robot.toml")):
            content = beside.read_bytes() if beside.is_file() else b""
            same_name = f'name = "{robot.name}"'.encode() in content.split(b"[[", 1)[0]
            if same_name and content != robot.files["robot.toml"]:
                lines[
                    f"{beside} differs from the description in {path.name}, which was used: "
                    f"--robot {beside} uses it"
                ] = None
    return list(lines)


def _corrected(
    options: argparse.Namespace, say: Callable[[str], None]
) -> tuple["results.Evidence", list[str]]:
    """Return the fit, with `--write-corrected` that by a corrected description, and what changed.

    Each fit is corrected by the mistakes that its tests name, those of the a priori links first,
    until none is named. The last description is written.
    """
    from acquisition.files import write_text

    from .. import export

    fit, lines = _identify(options, say), list[str]()
    if (path := options.write_corrected) is None:
        return fit, lines
    while line := max(
        (x for x in fit.trust.lines if x.case in ("cause", "mistake")),
        key=lambda x: x.case == "cause",
        default=None,
    ):
        named = line.finding.removesuffix("?")
        shared.Location(str(path)).require(
            line.causes and named not in lines,
            text=line.text,
            advice="Check which it is, and correct the description",
        )
        robot, changed = export.correct_description(
            fit.problem.signals.robot, line.causes, fit.problem.poses, str(path)
        )
        lines += [named, *changed]
        fit = _identify(options, say, robot.files)
    shared.COMMAND_LINE.require(
        lines,
        "--write-corrected",
        str(path),
        text="no test names a sign, zero or gain to be corrected, so nothing is written",
    )
    write_text(path, fit.problem.signals.robot.files["robot.toml"].decode())
    return fit, lines


def _identify(
    options: argparse.Namespace,
    say: Callable[[str], None],
    description: Mapping[str, bytes] | None = None,
) -> "results.Evidence":
    """Return the fit, by the files of a description in place of the recorded ones if it is given.

    The prior of the links is read before, so that a recording in A or V is refused at once.
    """
    from .. import data, methods, report, results

    overrides, sources, prior = (
        from_options(Overrides, options),
        shared.sources(options, description),
        None,
    )
    if options.consistent:
        robot = sources[0].load().robot
        if not options.gains:
            results.refuse_unknown_gain(robot)
        prior = results.read_prior(options.prior, robot) if options.prior else None
    iteration = None if options.start is None else methods.Iteration(start=options.start)
    if options.start not in (None, "regular", "ls"):
        stored = report.read_fit(Path(options.start))
        iteration = methods.Iteration(
            start=options.start, values=partial(results.stored_beta, stored, place=options.start)
        )
    fit = results.identify(
        data.Recordings(sources=tuple(sources), work=shared.work_of(options, len(sources))),
        overrides,
        method=options.method,
        essential=options.essential,
        iteration=iteration,
        say=say,
    )
    return results.with_consistent(fit, prior) if options.consistent else fit
