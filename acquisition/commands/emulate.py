"""`robot-acquire emulate`: simulated drives that any CANopen master can use."""

import argparse
import sys

from ..errors import BadInputError, Place
from .command_line import add_flag, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "robot", "ROBOT.toml", "description of robot and drives")
    add_path(parser, "--replay", "LOG.mcap", "the drives follow the samples of this recording")
    add_flag(
        parser, "--unsupervised", "simulate drives that do not detect a lost SYNC or a lost master"
    )
    parser.add_argument(
        "--duration", type=float, metavar="S", help="seconds to run (default: until Ctrl-C)"
    )


def run(options: argparse.Namespace) -> None:
    """Simulate the drives until the duration is over or a signal arrives."""
    import time

    import numpy as np

    from ..recording import read_recording
    from ..robot import load_robot, resolve
    from ..session import Stop, stop_on_signals
    from ..simulated import (
        DrivenPlant,
        SimulatedDrives,
        TablePlant,
        cascaded_loops,
        driven_plant,
        serve,
    )

    robot = load_robot(options.robot)
    bus = resolve(robot, str(options.robot))
    if bus.file.interface == "virtual":
        Place(str(options.robot), "bus").refuse(
            "interface",
            "virtual",
            "udp_multicast or socketcan",
            text="other programs cannot join it",
        )
    if options.replay is None:
        mechanism = driven_plant(robot, bus)
    else:
        recording = read_recording(options.replay)
        if recording.samples is None:
            raise BadInputError(
                recording.no_samples, place=str(options.replay), expected="some to replay"
            )
        mechanism = DrivenPlant(
            plant=TablePlant(recording.samples, recording.sample_rate_hz),
            loops=cascaded_loops(robot, np.ones(robot.n)),  # they have no effect
        )
    stop, end_s = (
        Stop(),
        time.monotonic() + (options.duration if options.duration is not None else float("inf")),
    )
    text = (
        f"simulated drives, nodes {', '.join(str(drive.node) for drive in bus.drives)}, "
        f"on {bus.file.interface} {bus.file.channel}"
        f"{f'; {mechanism.warning}' if mechanism.warning else ''}"
    )
    with stop_on_signals(stop):
        serve(
            SimulatedDrives(robot, bus, mechanism, supervised=not options.unsupervised),
            lambda: bool(stop.reason) or time.monotonic() > end_s,
            ready=lambda: print(text, file=sys.stderr, flush=True),
        )
