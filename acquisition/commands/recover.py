"""`robot-acquire recover`: a whole recording from one that was cut."""

import argparse
import sys
from pathlib import Path

from ..errors import one_line
from .command_line import Commands, Progress, add_overwrite


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("recover", help="a whole recording from one that was cut")
    parser.add_argument("recording", type=Path, metavar="CUT.mcap")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="OUT.mcap", help="the recording to write")
    add_overwrite(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Write the undamaged part of the recording, and print what it holds."""
    with Progress("recovering"):
        from ..files import refuse_clash
        from ..importing import recover_recording

        refuse_clash([options.recording], options.output, overwrite=options.overwrite)
        found, decoded = recover_recording(options.recording, options.output)
    for text in decoded.warnings or [f"no samples: {decoded.no_samples}"] * bool(decoded.no_samples):
        print(one_line(f"warning: {text}"), file=sys.stderr)
    frames = sum(len(block) for block in found.frames.values())
    held = f"{decoded.samples} samples, {frames} CAN frames, {len(found.events)} events"
    print(one_line(f"{options.output}: {found.robot.name}, {held}"))
