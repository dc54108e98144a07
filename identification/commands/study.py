"""`robot-identify study`: Monte-Carlo on a simulated robot, how far to trust least squares and iv."""

import argparse
from pathlib import Path

from acquisition.commands import Commands, from_options

from ..errors import IdentificationError
from .options import (
    add_simulation_options,
    add_work,
    controllers,
    cutoffs,
    factors,
    positive,
    refuse_outputs,
    share,
    work_of,
)
from .results import print_results
from .robots import add_robot, robot_of


def add(commands: Commands) -> None:
    """Declare the command; options have the names of the fields of `Study` and `Noise`."""
    parser = commands.add_parser(
        "study", help="Monte-Carlo on a simulated robot: how far to trust least squares and iv"
    )
    add_robot(parser, "with values to simulate with")
    varied = parser.add_argument_group("what is varied")
    varied.add_argument("--runs", type=positive, metavar="N", help="number of runs (default 100)")
    varied.add_argument(
        "--cutoffs", type=cutoffs, metavar="A,B,none", help="cut-offs, times the bandwidth (default 5,10,none)"
    )
    varied.add_argument(
        "--starts", type=factors, metavar="A,B", help="first inertias, times the true ones (default 0.05,1,20)"
    )
    varied.add_argument(
        "--gain-errors", type=factors, metavar="A,B", help="gains, times the true ones (default 0.7,1,1.3)"
    )
    varied.add_argument(
        "--controllers",
        type=controllers,
        metavar="A,B",
        help="described, or none: the fit is not given the control law (default described)",
    )
    varied.add_argument(
        "--vary",
        choices=["listed", "everything"],
        help="everything: each run draws imperfections of the cell and a controller as well (default listed)",
    )
    varied.add_argument("--low-speed-percent", type=share, metavar="P", help="as for fit")
    add_simulation_options(parser, encoder_step=1e-5, effort_noise_percent=2.0)
    add_work(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("--json", type=Path, metavar="FILE", help="write every run as JSON")
    outputs.add_argument("--rrd", type=Path, metavar="FILE", help="draw every run's error as a Rerun file")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the study, write what is asked for, print the table."""
    from rich.console import Console
    from rich.progress import track

    from ..report import write_json
    from ..study import Noise, Study, run_study, study_document, study_file, study_truth

    refuse_outputs([options.robot], options.json, options.rrd)
    robot = robot_of(options, moves=True)
    study = from_options(Study, options, noise=from_options(Noise, options))
    base, true = study_truth(robot)
    err = Console(stderr=True)
    with work_of(options, study.runs) as work:
        each = run_study(robot, study, work)
        runs = list(track(each, "runs", study.runs, console=err, transient=True, disable=not err.is_terminal))
    if not any(run.ls for run in runs):
        raise IdentificationError(f"no run can be fitted: {runs[0].reason}", place=str(options.robot))
    document = study_document(robot.name, study, runs, true)
    try:
        if options.json:
            write_json(options.json, study_file(study, runs, base, true))
        if options.rrd:
            from ..view import write_study_rrd

            write_study_rrd(options.rrd, robot.name, runs, true, document)
    finally:  # print the result of a long study even if a file cannot be written
        print_results(document)
