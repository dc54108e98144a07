"""`robot-acquire recover`: repair a recording that was cut off."""

import argparse
import sys

from ..errors import one_line
from .command_line import Progress, add_overwrite, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recording", "CUT.mcap", "the recording to repair")
    add_path(parser, "-o --output", "OUT.mcap", "the recording to write", required=True)
    add_overwrite(parser)


def run(options: argparse.Namespace) -> None:
    """Write the undamaged part of the recording, and print a summary."""
    with Progress("recovering"):
        from ..files import refuse_clash
        from ..importing import recover_recording

        refuse_clash([options.recording], options.output, overwrite=options.overwrite)
        found, decoded = recover_recording(options.recording, options.output)
    for text in decoded.warnings or [f"no samples: {decoded.no_samples}"] * bool(decoded.no_samples):
        print(one_line(f"warning: {text}"), file=sys.stderr)
    frames = sum(len(block) for block in found.frames.values())
    counts = f"{decoded.samples} samples, {frames} CAN frames, {len(found.events)} events"
    print(one_line(f"{options.output}: {found.robot.name}, {counts}"))
