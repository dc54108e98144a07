"""`robot-identify excite`: an exciting trajectory within the limits of the robot."""

import argparse

from acquisition.commands import Progress, add_flag, add_options, add_path, from_options

from ..options import ReferenceOptions, list_of_values
from . import arguments as shared


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = shared.add_robot(parser, "all joints need limits")
    add_path(
        inputs,
        "--fit",
        "FIT.json",
        "fit with the parameters and the noise (default: [parameters])",
    )
    add_path(
        inputs,
        "--after",
        "LOG.mcap",
        "earlier recordings of the robot, to which the trajectory adds information",
        nargs="+",
        default=[],
    )
    inputs.add_argument(
        "--payload",
        metavar="KG[@X,Y,Z]",
        help="payload of a second run of the reference, to identify drive gains: mass in kg and "
        "centre of mass in m",
    )
    inputs.add_argument(
        "--noise",
        type=list_of_values,
        metavar="A,B",
        help="standard deviation of the torque noise per row of the fit, in the unit of the "
        "effort, one value or one per joint (default: from FIT.json, else 2 %% of the rms torque)",
    )
    add_options(parser.add_argument_group("reference"), ReferenceOptions)
    outputs = parser.add_argument_group("outputs")
    add_path(
        outputs,
        "-o --out",
        "REF.csv",
        "reference to write, for `robot-acquire record --track`",
        required=True,
    )
    add_flag(outputs, "--all", "print the intervals of all parameters, not only the widest")
    shared.add_pictures(outputs, "write the reference and the intervals as a Rerun file")


def run(options: argparse.Namespace) -> None:
    """Search the reference, write it, and print the expected intervals."""
    shared.refuse_outputs(
        [options.robot, options.fit, *options.after],
        csv=options.out,
        rrd=options.rrd,
        report=options.report,
    )
    with Progress("excitation") as progress:
        from acquisition.robot import load_robot, parse_payload

        from ..design import ExcitationSettings, excitation_document, excite, prior_information

        robot = load_robot(options.robot)
        prior = prior_information(
            robot,
            options.robot.parent,
            fit=options.fit,
            noise=options.noise,
            after=options.after,
            payload=parse_payload(options.payload, robot) if options.payload else None,
        )
        found = excite(
            robot,
            from_options(ExcitationSettings, options),
            prior,
            str(options.robot),
            progress.say,
        )
    document = excitation_document(found)
    try:
        found.write(options.out)
        shared.write_pictures(
            options,
            document,
            lambda view: [view.draw_excitation(found, document)],
            [options.rrd] if options.rrd else (),
        )
    finally:
        shared.print_results(document, everything=options.all)
