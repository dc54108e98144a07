"""`robot-acquire decode`: a recording's CAN frames into joint samples again, by a corrected description."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import one_line
from .command_line import Commands, Progress, add_overwrite

if TYPE_CHECKING:
    from ..importing import Imported


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("decode", help="a recording's CAN frames into joint samples again")
    parser.add_argument("recording", type=Path, metavar="LOG.mcap")
    parser.add_argument("--robot", type=Path, metavar="CORRECTED.toml", help="in place of the description inside")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="OUT.mcap", help="the recording to write")
    add_overwrite(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Decode, and print what was decoded."""
    with Progress("decoding"):
        from ..files import refuse_clash
        from ..importing import decode_recording
        from ..robot import load_robot

        refuse_clash([options.recording, options.robot], options.output, overwrite=options.overwrite)
        robot = None if options.robot is None else load_robot(options.robot)
        place = str(options.robot or f"{options.recording}: robot.toml")
        found = decode_recording(options.recording, options.output, robot, place)
    print_decoded(found)


def print_decoded(found: "Imported") -> None:
    """Print warnings and size of a recording made of CAN frames."""
    for text in found.warnings:
        print(one_line(f"warning: {text}"), file=sys.stderr)
    reference = ", with reference" if found.has_reference else ""
    print(one_line(f"{found.out}: {found.robot}, {found.samples} samples at {found.sample_rate_hz:g} Hz{reference}"))
