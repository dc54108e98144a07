"""`robot-acquire disable`: stop and disable every drive of a description, whoever enabled it."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import AcquisitionError
from .command_line import Commands

if TYPE_CHECKING:
    from ..robot import Robot


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("disable", help="stop and disable all drives, whoever enabled them; never refused")
    parser.add_argument("robot", type=Path, metavar="ROBOT.toml")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Disable the drives. If some do not confirm it, the first line says which ones, and the status is 1."""
    from ..master import not_disabled
    from ..robot import load_robot

    robot = load_robot(options.robot)
    nodes = [drive.node for drive in robot.bus.drive] if robot.bus is not None else []
    try:
        unconfirmed = disable(robot, str(options.robot))
    except AcquisitionError:
        print(not_disabled(nodes), file=sys.stderr)
        raise
    if unconfirmed:
        print(not_disabled(unconfirmed), file=sys.stderr)
        return 1
    print(f"disabled: nodes {', '.join(map(str, nodes))}; all in pre-operational")
    return 0


def disable(robot: "Robot", place: str) -> list[int]:
    """Stop and disable every drive of the description, then set every node to PRE-OPERATIONAL.

    It is never refused, also when another program controls the drives: a session that still runs ends with a fault.

    Parameters
    ----------
    place : the name of the description in errors.

    Returns
    -------
    Node ids of the drives that did not confirm that they are disabled.

    Raises
    ------
    AcquisitionError
        The description is refused, or the bus cannot be opened.
    """
    from ..master import Master, leave_operational, safe_stop
    from ..robot import resolve
    from ..transport import open_link

    bus = resolve(robot, place)
    link = open_link(bus.file, passive=False)
    try:
        master = Master(link, bus)
        unconfirmed = safe_stop(master)
        leave_operational(master)
    finally:
        link.close()
    return unconfirmed
