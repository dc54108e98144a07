"""`robot-identify simulate`: a recording of a simulated robot with known parameters."""

import argparse
from pathlib import Path

from acquisition.commands import Commands, Progress, add_overwrite, from_options

from .options import add_simulation_options, refuse_outputs
from .results import print_results
from .robots import add_robot, robot_of


def add(commands: Commands) -> None:
    """Declare the command; options of the noise have the names of the fields of `Noise`."""
    parser = commands.add_parser("simulate", help="recording of a simulated robot with known parameters")
    add_robot(parser, "with values to simulate with")
    add_simulation_options(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("-o", "--out", type=Path, required=True, metavar="LOG.mcap", help="the recording to write")
    add_overwrite(outputs)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Simulate, write the recording, and say what it holds."""
    refuse_outputs([options.robot], options.out, overwrite=options.overwrite)
    with Progress("simulating"):
        from ..study import Noise, closed_loop, random_reference, write_signals

        robot, rate_hz, seed = robot_of(options, moves=True), options.sample_rate_hz, options.seed
        q_ref = random_reference(
            robot, duration_s=options.duration_s, sample_rate_hz=rate_hz, seed=seed, period_s=options.period_s
        )
        noise = from_options(Noise, options)
        signals = closed_loop(robot, q_ref, rate_hz, noise=noise, seed=seed)
        source = f"simulated: random reference and noise of seed {seed}"
        write_signals(options.out, signals, source=source, noise=noise)
    print_results(f"{options.out}: simulated, {options.duration_s:g} s at {rate_hz:g} Hz")
