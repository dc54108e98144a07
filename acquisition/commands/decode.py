"""`robot-acquire decode`: decode CAN frames into joint samples again, with a corrected description."""

import argparse
import sys
from typing import TYPE_CHECKING, TextIO

from ..errors import one_line
from .command_line import Progress, add_overwrite, add_path

if TYPE_CHECKING:
    from ..importing import ImportSummary


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "recording", "LOG.mcap", "the recording")
    add_path(parser, "--robot", "CORRECTED.toml", "use this description instead of the recording's own")
    add_path(parser, "-o --output", "OUT.mcap", "the recording to write", required=True)
    add_overwrite(parser)


def run(options: argparse.Namespace) -> None:
    """Decode, and print a summary."""
    with Progress("decoding"):
        from ..files import refuse_clash
        from ..importing import decode_recording
        from ..robot import load_robot

        refuse_clash([options.recording, options.robot], options.output, overwrite=options.overwrite)
        robot = None if options.robot is None else load_robot(options.robot)
        place = str(options.robot or f"{options.recording}: robot.toml")
        found = decode_recording(options.recording, options.output, robot, place)
    print_imported(found, sys.stderr)


def print_imported(found: "ImportSummary", warnings: TextIO) -> None:
    """Print a summary of the recording written, and its warnings to the stream `warnings`."""
    parts = [f"{found.out}: {found.robot}", f"{found.samples} samples at {found.sample_rate_hz:g} Hz"]
    parts += [f"effort in {', '.join(dict.fromkeys(found.effort_units))}"] if found.effort_units else []
    parts += ["with reference"] if found.has_reference else []
    print(one_line(", ".join([*parts, *(f"with {name.replace('_', ' ')}" for name in found.optional)])))
    if found.times:
        print(one_line(f"times: {found.times}"))
    for text in found.warnings:
        print(one_line(f"warning: {text}"), file=warnings)
