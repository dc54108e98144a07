"""`robot-identify init`: a robot.toml from a URDF; missing values are marked."""

import argparse
import os
from pathlib import Path

from acquisition.commands import add_path
from acquisition.errors import one_line

from ..errors import IdentificationError
from .arguments import add_urdf_options, chain_of, refuse_outputs


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "robot", "ROBOT.urdf", "the URDF", nargs="?")
    text = "without a URDF: a letter for each joint, R revolute or P prismatic; the DH rows are to be filled in"
    parser.add_argument("--dh", metavar="RRPRRR", help=text)
    add_urdf_options(parser)
    add_path(parser, "--bus", "BUS.toml", "the [bus] that `robot-acquire scan` wrote, instead of example drives")
    add_path(parser, "-o --out", "ROBOT.toml", "the description to write (default: standard output)")


def run(options: argparse.Namespace) -> None:
    """Write the description, and print its joints and the locked ones."""
    from acquisition.files import atomic_write

    from ..export import FILL_IN, describe, describe_rows

    out: Path | None = options.out
    refuse_outputs([path for path in (options.robot, options.bus) if path is not None], out)
    if out is not None and out.exists():
        expected = "a new name; descriptions are not replaced"
        raise IdentificationError("already exists", place=str(out), expected=expected)
    if (options.robot is None) == (options.dh is None) or (options.dh and options.joints):
        expected = "ROBOT.urdf, or --dh with a letter for each joint and without --joints"
        raise IdentificationError(key="--dh", value=options.dh, expected=expected)
    chain = chain_of(options)
    folder = Path.cwd() if out is None else out.absolute().parent
    bus = "" if options.bus is None else _bus_of(options.bus, len(chain.joints))
    urdf = options.robot and os.path.relpath(options.robot.absolute(), folder)
    text = describe(chain, urdf, bus) if urdf else describe_rows(chain, bus)
    if out is None:
        print(text, end="")
        return
    with atomic_write(out) as partial:
        partial.write_text(text, encoding="utf-8")
    lines = [f"{out}: {len(chain.joints)} joints of {options.robot or options.dh}"]
    lines += [f"joint {j + 1}: {joint.name}, {joint.type}" for j, joint in enumerate(chain.joints)]
    lines += [f"locked at zero: {locked}" for locked in chain.locked]
    lines += [f"note: {note}" for note in chain.notes]
    missing = sum(FILL_IN in line for line in text.splitlines()[1:])
    for line in [*lines, f"to be filled in: {missing} lines with {FILL_IN}"]:
        print(one_line(line))


def _bus_of(path: Path, joints: int) -> str:
    """The text of a file with `[bus]` and a drive for each joint."""
    text = path.read_text(encoding="utf-8", errors="replace")
    drives = text.count("[[bus.drive]]")
    if drives != joints:
        expected = f"{joints} [[bus.drive]], one for each joint of the URDF"
        raise IdentificationError(place=str(path), key="drives", value=drives, expected=expected)
    return text
