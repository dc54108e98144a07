"""`robot-identify study`: least squares and iv on a simulated robot, or on a varied recording."""

import argparse
from hashlib import sha256
from time import perf_counter

from acquisition.commands import Progress, add_flag, add_options, add_path, from_options
from acquisition.errors import Location

from ..options import CellOptions, StudyOptions, list_of_noises
from . import arguments as shared

DEFAULTS = {"seed": 1, "effort_percent": 2.0}  # of simulated runs; an option not given is None
POSITION_NOISE = 3e-6  # of simulated runs


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(
        inputs,
        "input",
        "ROBOT.toml|LOG.mcap",
        "robot description with [parameters], to simulate and fit recordings; or a recording, to "
        "fit it with other settings, position noise and initial parameters",
    )
    inputs.add_argument(
        "--position-noise",
        type=list_of_noises,
        metavar="Q,Q",
        help=f"position noise, rad or m rms: for simulations one value (default: "
        f"{POSITION_NOISE:g}), for a recording one or several to be added (default: from the "
        "travel)",
    )
    simulated = parser.add_argument_group("simulated recordings, with ROBOT.toml")
    add_options(simulated, StudyOptions, **DEFAULTS)
    add_options(
        simulated, CellOptions, "effort_percent", "coloured_percent", "lag_samples", **DEFAULTS
    )
    add_path(simulated, "--json", "FILE", "write every run as JSON")
    recorded = parser.add_argument_group("one recording, with LOG.mcap")
    add_path(recorded, "--robot", "ROBOT.toml", "use this description instead of the recorded one")
    add_flag(recorded, "--all", "also print the values and intervals of all fits")
    parser.set_defaults(simulated=simulated, recorded=recorded, **dict.fromkeys(DEFAULTS))
    shared.add_work(parser)
    shared.add_report(parser.add_argument_group("outputs"))


def run(options: argparse.Namespace) -> None:
    """Fit simulated recordings or variants of a recording, write the files, print the table."""
    from acquisition.files import is_recording

    shared.refuse_outputs([options.input, options.robot], json=options.json, report=options.report)
    recorded = is_recording(options.input)
    for action in (options.simulated if recorded else options.recorded)._group_actions:
        Location(str(options.input)).require(
            getattr(options, action.dest) in (None, False),
            text=f"{action.option_strings[0]} requires "
            f"{'ROBOT.toml, not a recording' if recorded else 'LOG.mcap, not a description'}",
        )
    options.all |= not recorded
    (_of_recording if recorded else _of_robot)(options)


def _of_robot(options: argparse.Namespace) -> None:
    """Simulate and fit the runs of a Monte-Carlo study."""
    from acquisition.robot import load_robot

    from ..study import (
        Noise,
        Run,
        Study,
        border_line,
        run_study,
        study_document,
        study_file,
        study_truth,
    )

    position, *more = options.position_noise or (POSITION_NOISE,)
    shared.COMMAND_LINE.require(
        not more, "--position-noise", options.position_noise, "one value for a simulated robot"
    )
    vars(options).update({k: x for k, x in DEFAULTS.items() if getattr(options, k) is None})
    robot = load_robot(options.input)
    study = from_options(Study, options, noise=from_options(Noise, options, position=position))
    base, true = study_truth(robot)
    runs, began = list[Run](), perf_counter()
    with Progress("simulating") as progress:
        for one in run_study(robot, study, shared.work_of(options, study.runs)):
            runs.append(one)
            progress.say(f"{len(runs)} of {study.runs} runs")
    took_s = perf_counter() - began
    Location(str(options.input)).require(
        any(run.ls for run in runs), text=f"no run could be fitted: {runs[0].reason}"
    )
    document = study_document(robot.name, study, runs, true)
    shared.show_results(
        options,
        document,
        lambda: study_file(study, runs, base, true),
        lambda view: [view.draw_study(robot.name, runs, document)],
        lines=(*border_line(robot), f"{took_s:.3g} s, {took_s / study.runs:.2g} s per run"),
    )


def _of_recording(options: argparse.Namespace) -> None:
    """Fit a recording in all variants, to see how far the estimates move."""
    noises = options.position_noise
    shared.COMMAND_LINE.require(
        0 not in (noises or ()),
        "--position-noise",
        noises,
        "numbers greater than 0 for a recording",
    )
    options.recordings = [options.input]
    with Progress("fitting"):
        from ..study import sensitivity_document, vary

        fits = vary(
            shared.sources(options)[0], noises, shared.work_of(options, len(noises or "abc") + 9)
        )
        document = sensitivity_document(options.input.name, fits)
    digests = {options.input.name: sha256(options.input.read_bytes()).hexdigest()}
    shared.show_results(
        options, document, dict, lambda view: [view.draw_sensitivity(digests, fits, document)]
    )
