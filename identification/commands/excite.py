"""`robot-identify excite`: a reference that tells most of a robot's parameters, within its limits."""

import argparse

from acquisition.commands import Progress, add_options, add_path, from_options

from ..options import ReferenceOptions, list_of_factors
from .arguments import add_robot, print_results, refuse_outputs, robot_of


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = add_robot(parser, "with limits of all joints")
    add_path(inputs, "--fit", "FIT.json", "parameters and noise of this fit (default: [parameters])")
    text = "earlier recordings of the robot: their information adds to that of the reference"
    add_path(inputs, "--after", "LOG.mcap", text, nargs="+", default=[])
    text = (
        "deviation of the torque in a row of the fit, one or one per joint (default: of FIT.json, else 2 %% of the rms)"
    )
    inputs.add_argument("--noise", type=list_of_factors, metavar="A,B", help=text)
    add_options(parser.add_argument_group("reference"), ReferenceOptions)
    outputs = parser.add_argument_group("outputs")
    add_path(outputs, "-o --out", "REF.csv", "the reference, for `robot-acquire record --track`", required=True)
    add_path(outputs, "--rrd", "FILE", "draw the reference and the intervals as a Rerun file")


def run(options: argparse.Namespace) -> None:
    """Search the reference, write it, print what is expected of it."""
    refuse_outputs([options.robot, options.fit, *options.after], options.out, options.rrd)
    with Progress("excitation") as progress:
        import numpy as np

        from acquisition.files import write_columns

        from ..design import ExcitationSettings, excitation_document, excite, prior_information

        robot = robot_of(options, moves=True)
        settings = from_options(ExcitationSettings, options)
        knowledge = prior_information(
            robot, options.robot.parent, fit=options.fit, noise=options.noise, after=options.after
        )
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
