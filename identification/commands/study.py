"""`robot-identify study`: Monte-Carlo study of least squares and iv on a simulated robot."""

import argparse
from time import perf_counter

from acquisition.commands import Progress, add_options, add_path, from_options

from ..errors import BadInputError
from ..options import StudyOptions
from . import arguments as shared


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    shared.add_robot(parser, "with [parameters]")
    add_options(parser, StudyOptions, "runs")
    noise = "position", "effort_percent", "coloured_percent", "lag_samples"
    shared.add_simulation(parser, *noise, position=3e-6, effort_percent=2.0)
    shared.add_work(parser)
    outputs = parser.add_argument_group("outputs")
    add_path(outputs, "--json", "FILE", "write every run as JSON")
    shared.add_report(outputs)


def run(options: argparse.Namespace) -> None:
    """Run the study, write the requested files, print the table."""
    from acquisition.robot import load_robot

    from ..report import write_json
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

    shared.refuse_outputs([options.robot], json=options.json, report=options.report)
    robot = load_robot(options.robot)
    study = from_options(Study, options, noise=from_options(Noise, options))
    base, true = study_truth(robot)
    runs, began = list[Run](), perf_counter()
    with Progress("simulating") as progress:
        for one in run_study(robot, study, shared.work_of(options, study.runs)):
            runs.append(one)
            progress.say(f"{len(runs)} of {study.runs} runs")
    took_s = perf_counter() - began
    if not any(run.ls for run in runs):
        raise BadInputError(f"no run can be fitted: {runs[0].reason}", place=str(options.robot))
    document = study_document(robot.name, study, runs, true)
    try:
        if options.json:
            write_json(options.json, study_file(study, runs, base, true))
        shared.write_pictures(
            options, document, lambda view: [view.draw_study(robot.name, runs, document)]
        )
    finally:  # print the result of a long study even if a file cannot be written
        took = f"{took_s:.3g} s, {took_s / study.runs:.2g} s a run"
        shared.print_results(document, *border_line(robot), took)
