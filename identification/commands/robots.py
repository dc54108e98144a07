"""The robot of a command: a robot.toml, or a URDF with options for what it does not say.

A command calls `add_robot` and `robot_of`, which see to both.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import IdentificationError
from .options import above_zero

if TYPE_CHECKING:
    from acquisition.robot import Robot

    from ..export import Chain

_STATED = (
    ("--range", "Q", "positions, rad or m to each side of zero; where the URDF has limits too, the narrower hold"),
    ("--speed", "V", "largest speed, rad/s or m/s; where the URDF has one too, the smaller holds"),
    ("--acceleration", "A", "largest acceleration, rad/s² or m/s²"),
    ("--following-error", "Q", "largest following error, rad or m"),
    ("--bandwidth-hz", "F", "bandwidth of the position loop; of several the lowest holds"),
)


def add_robot(parser: argparse.ArgumentParser, text: str) -> "argparse._ArgumentGroup":
    """The group of inputs with the robot, and the options of a URDF; `text` says what of a description is needed."""
    inputs = parser.add_argument_group("inputs")
    inputs.add_argument("robot", type=Path, metavar="ROBOT", help=f"robot.toml or a URDF; {text}")
    add_urdf_options(parser)
    return inputs


def add_urdf_options(parser: argparse.ArgumentParser) -> None:
    """Options for what a URDF does not say."""
    group = parser.add_argument_group("with a URDF: one value for all joints, or one per joint, as A,B,C")
    group.add_argument(
        "--joints",
        type=names,
        metavar="A,B",
        help="the joints to identify, from the base outwards (default: those of the longest serial chain)",
    )
    for option, metavar, what in _STATED:
        group.add_argument(option, type=values, metavar=metavar, help=what)


def robot_of(options: argparse.Namespace, *, moves: bool = False) -> "Robot":
    """The robot that the options of `add_robot` describe; where it `moves`, a URDF or its options must state the limits."""
    from acquisition.robot import load_robot

    from ..export import is_urdf, robot_of_chain

    if is_urdf(options.robot):
        return robot_of_chain(chain_of(options), moves=moves)
    for option in (*(["--joints"] if options.joints is not None else []), *_stated(options)):
        expected = "a URDF with it: robot.toml has a key of its own for it"
        raise IdentificationError(f"{option} does nothing here", place=str(options.robot), expected=expected)
    return load_robot(options.robot)


def chain_of(options: argparse.Namespace) -> "Chain":
    """The chain of the URDF, with what the options state."""
    from ..export import read_chain

    return read_chain(options.robot, options.joints or ()).with_options(_stated(options))


def _stated(options: argparse.Namespace) -> dict[str, tuple[float, ...]]:
    """By name, the options given for what a URDF does not say."""
    given = {option: getattr(options, option.removeprefix("--").replace("-", "_")) for option, _, _ in _STATED}
    return {option: values for option, values in given.items() if values is not None}


def names(text: str) -> tuple[str, ...]:
    """Names separated by commas."""
    found = tuple(part.strip() for part in text.split(","))
    if not all(found):
        raise ValueError(text)
    return found


def values(text: str) -> tuple[float, ...]:
    """Numbers above 0 separated by commas."""
    return tuple(above_zero(part) for part in text.split(","))
