"""`robot-acquire disable`: stop and disable all drives of a description."""

import argparse
import sys

from .command_line import add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "robot", "ROBOT.toml", "description of the robot and its drives")


def run(options: argparse.Namespace) -> int:
    """Disable the drives.

    If some do not confirm, the first line names them and the status is 1.
    """
    from ..bus import not_disabled, stop_drives
    from ..robot import load_robot, resolve

    robot = load_robot(options.robot)
    nodes = [drive.node for drive in robot.bus.drive] if robot.bus is not None else []
    try:
        unconfirmed = stop_drives(resolve(robot, str(options.robot)))
    # After any exception, also Ctrl-C, the state of the drives is unknown.
    except BaseException:
        print(not_disabled(nodes), file=sys.stderr)
        raise
    if unconfirmed:
        print(not_disabled(unconfirmed), file=sys.stderr)
        return 1
    print(f"disabled: nodes {', '.join(map(str, nodes))}, all in NMT state pre-operational")
    return 0
