"""`robot-identify excite`: a reference that tells most of a robot's parameters, within its limits."""

import argparse
from pathlib import Path

from acquisition.commands import Commands, Progress, from_options

from .options import above_zero, at_least_two, factors, percent, positive, refuse_outputs, whole
from .results import print_results
from .robots import add_robot, robot_of


def add(commands: Commands) -> None:
    """Declare the command; options have the names of the fields of `ExcitationSettings`."""
    parser = commands.add_parser(
        "excite", help="a reference that tells most of a robot's parameters, within its limits"
    )
    inputs = add_robot(parser, "with limits of all joints")
    inputs.add_argument(
        "--fit", type=Path, metavar="FIT.json", help="parameters and noise of this fit (default: [parameters])"
    )
    inputs.add_argument(
        "--after",
        type=Path,
        nargs="+",
        default=[],
        metavar="LOG.mcap",
        help="earlier recordings of the robot: their information adds to that of the reference",
    )
    inputs.add_argument(
        "--noise",
        type=factors,
        metavar="A,B",
        help="deviation of the torque in a row of the fit, one or one per joint (default: of FIT.json, else 2 %% of the rms)",
    )
    reference = parser.add_argument_group("reference")
    reference.add_argument(
        "--period", dest="period_s", type=above_zero, metavar="S", help="of the Fourier series, s (default 10)"
    )
    reference.add_argument("--harmonics", type=at_least_two, metavar="H", help="of the series (default 10)")
    reference.add_argument("--periods", type=positive, metavar="N", help="how often it is repeated (default 3)")
    reference.add_argument("--seed", type=whole, metavar="K", help="of the searches' starts (default 1)")
    reference.add_argument(
        "--limits-percent", type=percent, metavar="P", help="share of all limits that it may use (default 80)"
    )
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        metavar="REF.csv",
        help="the reference, for `robot-acquire record --track`",
    )
    outputs.add_argument(
        "--rrd", type=Path, metavar="FILE", help="draw the reference and the intervals as a Rerun file"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Search the reference, write it, print what is expected of it."""
    refuse_outputs([options.robot, options.fit, *options.after], options.out, options.rrd)
    with Progress("excitation") as progress:
        import numpy as np

        from acquisition.files import write_columns

        from ..design import ExcitationSettings, excitation_document, excite, knowledge_of

        robot = robot_of(options, moves=True)
        settings = from_options(ExcitationSettings, options)
        knowledge = knowledge_of(robot, options.robot.parent, fit=options.fit, noise=options.noise, after=options.after)
        found = excite(robot, settings, knowledge, str(options.robot), progress.say)
    document = excitation_document(found)
    try:
        time_s, q = found.table()
        write_columns(options.out, ("time_s", *(joint.name for joint in robot.joints)), [np.column_stack([time_s, q])])
        if options.rrd:
            from ..view import write_excitation_rrd

            write_excitation_rrd(options.rrd, found, document)
    finally:
        print_results(document)
