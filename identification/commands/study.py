"""`robot-identify study`: Monte-Carlo study of least squares and iv on a simulated robot."""

import argparse

from acquisition.commands import add_options, add_path, from_options

from ..errors import IdentificationError
from ..options import StudyOptions
from .arguments import (
    add_pictures,
    add_robot,
    add_simulation,
    add_work,
    print_results,
    refuse_outputs,
    robot_of,
    work_of,
    write_pictures,
)


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser, "with [parameters]")
    varied = parser.add_argument_group("what is varied")
    names = ("runs", "cutoffs", "starts", "gain_errors", "controllers", "vary", "low_speed_percent")
    add_options(varied, StudyOptions, *names)
    add_simulation(parser, encoder_step=1e-5, effort_percent=2.0)
    add_work(parser)
    outputs = parser.add_argument_group("outputs")
    add_path(outputs, "--json", "FILE", "write every run as JSON")
    add_pictures(outputs, "draw every run's error as a Rerun file")


def run(options: argparse.Namespace) -> None:
    """Run the study, write the requested files, print the table."""
    from time import perf_counter

    from rich.console import Console
    from rich.progress import track

    from ..report import write_json
    from ..study import Noise, Study, border_line, run_study, study_document, study_file, study_truth

    refuse_outputs([options.robot], options.json, options.rrd, report=options.report)
    robot = robot_of(options, moves=True)
    study = from_options(Study, options, noise=from_options(Noise, options))
    base, true = study_truth(robot)
    err, began = Console(stderr=True), perf_counter()
    results = run_study(robot, study, work_of(options, study.runs))
    runs = list(track(results, "runs", study.runs, console=err, transient=True, disable=not err.is_terminal))
    took_s = perf_counter() - began
    if not any(run.ls for run in runs):
        raise IdentificationError(f"no run can be fitted: {runs[0].reason}", place=str(options.robot))
    document = study_document(robot.name, study, runs, true)
    try:
        if options.json:
            write_json(options.json, study_file(study, runs, base, true))

        write_pictures(options, document, lambda view: [view.draw_study(robot.name, runs, true, document)])
    finally:  # print the result of a long study even if a file cannot be written
        took = f"{took_s:.3g} s, {took_s / study.runs:.2g} s a run"
        print_results(document, *border_line(robot), took)
