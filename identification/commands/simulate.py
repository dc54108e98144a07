"""`robot-identify simulate`: a recording of a simulated robot with known parameters."""

import argparse

from acquisition.commands import Progress, add_options, add_overwrite, add_path, from_options

from ..options import CellOptions, StudyOptions
from .arguments import add_robot, print_results, refuse_outputs


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser, "needs [parameters]")
    simulated = parser.add_argument_group("simulated recording")
    add_options(simulated, StudyOptions, "duration_s", "sample_rate_hz", "seed", seed=1)
    add_options(simulated, CellOptions)
    parser.add_argument(
        "--payload",
        metavar="KG[@X,Y,Z]",
        help="payload: mass in kg and centre of mass in m",
    )
    outputs = parser.add_argument_group("outputs")
    add_path(outputs, "-o --out", "LOG.mcap", "recording to write", required=True)
    add_overwrite(outputs)


def run(options: argparse.Namespace) -> None:
    """Simulate, write the recording, and print a summary."""
    refuse_outputs([options.robot], mcap=options.out, overwrite=options.overwrite)
    with Progress("simulating"):
        from acquisition.robot import load_robot, parse_payload

        from ..study import Noise, Study, simulate_recording

        robot = load_robot(options.robot)
        study = from_options(Study, options, noise=from_options(Noise, options))
        simulate_recording(
            robot,
            options.out,
            study,
            parse_payload(options.payload, robot) if options.payload else None,
        )
    print_results(
        f"{options.out}: simulated recording of {study.duration_s:g} s at "
        f"{study.sample_rate_hz:g} Hz"
    )
