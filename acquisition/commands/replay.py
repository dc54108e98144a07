"""`robot-acquire replay`: what a recording's drives sent, and SYNC, on a silent bus."""

import argparse

from ..errors import one_line
from .command_line import add_flag, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recording", "LOG.mcap")
    parser.add_argument("--interface", required=True, help="python-can's name: socketcan, udp_multicast, ...")
    parser.add_argument("--channel", required=True, help="can0, or a multicast group")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times as fast; default 1")
    add_flag(parser, "--onto-bus", "also where hardware may be on the bus")


def run(options: argparse.Namespace) -> None:
    """Send the frames, and print their number."""
    from ..robot import BusFile
    from ..session import Stop, replay, stop_on_signals

    stop = Stop()
    file = BusFile(interface=options.interface, channel=options.channel, drive=(), sync_period_s=1.0)
    with stop_on_signals(stop):
        count = replay(options.recording, file, stop, speed=options.speed, onto_bus=options.onto_bus)
    print(one_line(f"{count} frames sent on {options.interface} {options.channel}"))
