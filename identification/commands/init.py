"""`robot-identify init`: a robot.toml from a URDF; missing values are marked."""

import argparse
import os
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

from acquisition.commands import add_flag, add_path
from acquisition.errors import COMMAND_LINE, Location, one_line

from ..options import list_of_names, list_of_ratios, list_of_values
from .arguments import refuse_outputs

if TYPE_CHECKING:
    from ..export import Chain

_URDF_OPTIONS = {
    "position": (
        "--range",
        "Q",
        "position limits, ± rad or m; if the URDF has limits too, the narrower ones are used",
    ),
    "speed": (
        "--speed",
        "V",
        "maximum speed, rad/s or m/s; if the URDF has one too, the smaller one is used",
    ),
    "acceleration": ("--acceleration", "A", "maximum acceleration, rad/s² or m/s²"),
    "following_error": ("--following-error", "Q", "maximum following error, rad or m"),
    "bandwidth_hz": (
        "--bandwidth-hz",
        "F",
        "bandwidth of the position loop, Hz; if several are given, the lowest one is used",
    ),
}


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "robot", "ROBOT.urdf", "URDF of the robot", nargs="?")
    parser.add_argument(
        "--dh",
        metavar="RRPRRR",
        help="a letter for each joint, in place of a URDF: R (revolute) or P (prismatic); fill in "
        "the marked DH rows",
    )
    group = parser.add_argument_group(
        "values that a URDF lacks: one for all joints, or one per joint, as A,B,C"
    )
    group.add_argument(
        "--joints",
        type=list_of_names,
        metavar="A,B",
        help="joints to identify, from the base outwards (default: the longest serial chain)",
    )
    for name, (option, metavar, text) in _URDF_OPTIONS.items():
        group.add_argument(option, dest=name, type=list_of_values, metavar=metavar, help=text)
    group.add_argument(
        "--effort",
        choices=["A", "N m", "%"],
        help="unit of the recorded efforts; %% is percent of the rated torque (default: that "
        "of the drives, with --bus)",
    )
    group.add_argument(
        "--ratio",
        type=list_of_ratios,
        metavar="R",
        help="motor rad (or m) per joint rad (or m), sign included; requires --effort or --bus",
    )
    group.add_argument(
        "--drive-gain",
        type=list_of_values,
        metavar="K",
        help="motor torque in N m (or force in N) per unit of effort; requires efforts in A or %%",
    )
    add_flag(
        group,
        "--torque-sensor",
        "efforts are from joint torque sensors, which do not measure rotor inertia; requires "
        "--effort 'N m'",
    )
    add_path(
        parser,
        "--bus",
        "BUS.toml",
        "[bus] that `robot-acquire scan` wrote, in place of example drives",
    )
    add_path(parser, "-o --out", "ROBOT.toml", "description to write (default: standard output)")
    add_flag(parser, "--overwrite", "replace an existing description")


def run(options: argparse.Namespace) -> None:
    """Write the description, and print its joints and the locked ones."""
    from acquisition.files import write_text

    from ..export import chain_of_letters, describe, describe_rows, read_chain

    out = options.out
    refuse_outputs([options.robot, options.bus], toml=out)
    Location(str(out)).require(
        out is None or not out.exists() or options.overwrite,
        text="already exists",
        advice="Choose a new name, or add --overwrite",
    )
    COMMAND_LINE.require(
        (options.robot is None) != (options.dh is None) and not (options.dh and options.joints),
        "--dh",
        options.dh,
        text="the joints come either from a URDF or from --dh",
        advice="Pass ROBOT.urdf, optionally with --joints, or --dh with a letter for each joint",
    )
    chain = (
        chain_of_letters(options.dh)
        if options.dh
        else read_chain(options.robot, options.joints or ())
    )
    bus = b"" if options.bus is None else options.bus.read_bytes()
    chain = _with_options(chain, options, bus)
    urdf = options.robot and os.path.relpath(options.robot, out and out.parent)
    text = describe(chain, urdf, bus.decode()) if urdf else describe_rows(chain, bus.decode())
    if out is None:
        print(text, end="")
        return
    write_text(out, text)
    print(one_line(f"{out}: {len(chain.joints)} joints of {options.robot or options.dh}"))
    for line in (*_joint_lines(chain), *_lines_to_fill_in(text)):
        print(one_line(line))


def _joint_lines(chain: "Chain") -> Iterator[str]:
    """Return lines on the joints, and on special features of the chain."""
    yield from (f"joint {j}: {joint.name}, {joint.type}" for j, joint in enumerate(chain.joints, 1))
    yield from (f"locked at zero: {locked}" for locked in chain.locked)
    yield from (f"note: {note}" for note in chain.notes)
    if chain.torque_sensors:
        yield (
            "rotor_inertia = false, because torque sensors do not measure rotors; the torque of a "
            "motor would include its rotor"
        )


def _lines_to_fill_in(text: str) -> Iterator[str]:
    """Count the marked lines of a description, and name those that each use needs."""
    from acquisition.robot import marks_of_motion

    from ..export import FILL_IN, USES

    marked = [(k, x) for k, x in enumerate(text.splitlines(), 1) if FILL_IN in x][1:]
    moving = marks_of_motion(text)
    yield f"to be filled in: {len(marked)} lines with {FILL_IN}"
    for use in USES:
        lines = [
            str(k)
            for k, x in marked
            if re.search(f"{FILL_IN}{use}(:|$)", x) or (use == USES[-1] and k in moving)
        ]
        yield f"of these, lines needed{use}: {', '.join(lines) or 'none'}"


def _with_options(chain: "Chain", options: argparse.Namespace, bus: bytes) -> "Chain":
    """Apply the options that a URDF lacks, and the units of the drives of `--bus`."""
    from acquisition.robot import efforts_of_scan

    given = {
        name: values
        for name in (*_URDF_OPTIONS, "ratio", "drive_gain", "torque_sensor")
        if (values := getattr(options, name))
    }
    of_drives = [] if options.bus is None else efforts_of_scan(bus, str(options.bus))
    Location(str(options.bus)).require(
        options.bus is None or len(of_drives) == len(chain.joints),
        "drives",
        len(of_drives),
        f"{len(chain.joints)}, one [[bus.drive]] for each joint of the URDF",
    )
    stated = chain.units_of([options.effort or ""])
    COMMAND_LINE.require(
        not (options.effort and of_drives) or {*of_drives} <= {options.effort, *stated},
        "--effort",
        options.effort,
        text=f"the drives in {options.bus} report {', '.join(of_drives)}",
        advice="Omit --effort",
    )
    efforts = [unit or said for unit, said in zip(of_drives or stated, stated, strict=True)]
    return chain.with_efforts(efforts, given)
