"""`robot-identify simulate`: a recording of a simulated robot with known parameters."""

import argparse

from acquisition.commands import Progress, add_overwrite, add_path, from_options

from .arguments import add_robot, add_simulation, print_results, refuse_outputs, robot_of


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser, "with [parameters]")
    add_simulation(parser)
    parser.add_argument("--payload", metavar="KG[@X,Y,Z]", help="what the robot carries: mass, and centre of mass in m")
    outputs = parser.add_argument_group("outputs")
    add_path(outputs, "-o --out", "LOG.mcap", "the recording to write", required=True)
    add_overwrite(outputs)


def run(options: argparse.Namespace) -> None:
    """Simulate, write the recording, and print a summary."""
    refuse_outputs([options.robot], options.out, overwrite=options.overwrite)
    with Progress("simulating"):
        from acquisition.robot import parse_payload

        from ..study import Noise, Study, closed_loop, random_reference, write_signals

        robot, study, noise = robot_of(options, moves=True), from_options(Study, options), from_options(Noise, options)
        duration_s, rate_hz, seed = study.duration_s, study.sample_rate_hz, study.seed
        q_ref = random_reference(
            robot, duration_s=duration_s, sample_rate_hz=rate_hz, seed=seed, period_s=study.period_s
        )
        payload = parse_payload(options.payload, robot) if options.payload else None
        signals = closed_loop(robot, q_ref, rate_hz, noise=noise, seed=seed, payload=payload)
        source = f"simulated: random reference and noise of seed {seed}"
        write_signals(options.out, signals, source=source, noise=noise)
    print_results(f"{options.out}: simulated, {duration_s:g} s at {rate_hz:g} Hz")
