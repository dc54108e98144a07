"""`robot-acquire emulate`: run simulated drives for any CANopen master, or replay recorded ones."""

import argparse
import sys
from collections.abc import Callable

from ..errors import COMMAND_LINE, Location, one_line
from .command_line import add_bus, add_flag, add_path

OF_DESCRIPTION, OF_RECORDING = "a robot.toml", "a recording"
OPTIONS = {
    OF_DESCRIPTION: ("replay", "unsupervised", "duration"),
    OF_RECORDING: ("interface", "channel", "speed", "onto_bus"),
}


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(
        parser,
        "file",
        "FILE",
        "robot.toml to simulate, or recording whose drives and SYNC are replayed",
    )
    description = parser.add_argument_group(f"options for {OF_DESCRIPTION}")
    add_path(
        description, "--replay", "LOG.mcap", "let the drives follow the samples of this recording"
    )
    add_flag(
        description,
        "--unsupervised",
        "simulate drives that detect neither a lost SYNC nor a lost master",
    )
    description.add_argument(
        "--duration", type=float, metavar="S", help="time to run in s (default: until Ctrl-C)"
    )
    recording = parser.add_argument_group(f"options for {OF_RECORDING}")
    add_bus(recording, required=False)
    recording.add_argument(
        "--speed", type=float, metavar="X", help="speed factor, greater than 0 (default: 1)"
    )
    add_flag(recording, "--onto-bus", "allow an interface to which hardware may be connected")


def run(options: argparse.Namespace) -> None:
    """Emulate the drives of the file, until the replay has ended or a signal arrives."""
    from ..files import is_recording
    from ..robot import BusFile
    from ..session import Stop, replay, stop_on_signals

    is_played = is_recording(options.file)
    other = OF_DESCRIPTION if is_played else OF_RECORDING
    for name in OPTIONS[other]:
        Location(f"--{name.replace('_', '-')}").require(
            getattr(options, name) in (None, False),
            text=f"this option is only for {other}",
            advice=f"Remove it, or pass {other} as FILE",
        )
    for name in ("interface", "channel") if is_played else ():
        COMMAND_LINE.require(
            getattr(options, name) is not None,
            f"--{name}",
            None,
            text="the frames need a bus",
            advice="Name it: --interface NAME --channel NAME",
        )
    stop = Stop()
    with stop_on_signals(stop):
        if not is_played:
            return _simulate(options, lambda: bool(stop.reason))
        file = BusFile(
            interface=options.interface, channel=options.channel, drive=(), sync_period_s=1.0
        )
        count = replay(
            options.file,
            file,
            stop,
            speed=1.0 if options.speed is None else options.speed,
            onto_bus=options.onto_bus,
        )
    print(one_line(f"{count} frames sent on {file.interface} {file.channel}"))


def _simulate(options: argparse.Namespace, stopped: Callable[[], bool]) -> None:
    """Simulate the drives of a description."""
    import time

    import numpy as np

    from ..recording import read_recording
    from ..robot import load_robot, resolve
    from ..simulated import (
        DrivenPlant,
        SimulatedDrives,
        TablePlant,
        cascaded_loops,
        driven_plant,
        serve,
    )

    robot = load_robot(options.file)
    bus = resolve(robot, str(options.file))
    Location(str(options.file), "bus").require(
        bus.file.interface != "virtual",
        "interface",
        "virtual",
        "udp_multicast or socketcan",
        text="other programs cannot use this bus",
    )
    if options.replay is None:
        mechanism = driven_plant(robot, bus)
    else:
        recording = read_recording(options.replay)
        samples = Location(str(options.replay)).given(
            recording.samples, text=f"it has no samples to replay: {recording.no_samples}"
        )
        mechanism = DrivenPlant(
            plant=TablePlant(samples, recording.sample_rate_hz),
            # The loops have no effect, because the table prescribes the efforts.
            loops=cascaded_loops(robot, np.ones(robot.n)),
        )
    end_s = time.monotonic() + (float("inf") if options.duration is None else options.duration)
    text = (
        f"simulated drives, nodes {', '.join(str(drive.node) for drive in bus.drives)}, "
        f"on {bus.file.interface} {bus.file.channel}"
        f"{f'; {mechanism.warning}' if mechanism.warning else ''}"
    )
    serve(
        SimulatedDrives(robot, bus, mechanism, supervised=not options.unsupervised),
        lambda: stopped() or time.monotonic() > end_s,
        ready=lambda: print(text, file=sys.stderr, flush=True),
    )
