"""`robot-acquire replay`: play the drives' frames and SYNC of a recording onto an idle bus."""

import argparse

from ..errors import one_line
from .command_line import add_flag, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recording", "LOG.mcap", "the recording")
    add_bus(parser)
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="speed factor, above 0 (default 1)"
    )
    add_flag(parser, "--onto-bus", "allow an interface that may lead to hardware")


def add_bus(parser: argparse.ArgumentParser) -> None:
    """Declare the bus of a command without robot.toml."""
    parser.add_argument(
        "--interface",
        required=True,
        metavar="NAME",
        help="interface name of python-can: socketcan, udp_multicast, ...",
    )
    parser.add_argument(
        "--channel",
        required=True,
        metavar="NAME",
        help="channel, such as can0 or a multicast group",
    )


def run(options: argparse.Namespace) -> None:
    """Send the frames, and print their number."""
    from ..robot import BusFile
    from ..session import Stop, replay, stop_on_signals

    stop = Stop()
    with stop_on_signals(stop):
        count = replay(
            options.recording,
            BusFile(
                interface=options.interface, channel=options.channel, drive=(), sync_period_s=1.0
            ),
            stop,
            speed=options.speed,
            onto_bus=options.onto_bus,
        )
    print(one_line(f"{count} frames sent on {options.interface} {options.channel}"))
