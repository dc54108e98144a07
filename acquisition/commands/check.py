"""`robot-acquire check`: who answers on the bus, and whether it is as described; go or no go."""

import argparse
from pathlib import Path

from ..errors import AcquisitionError
from .command_line import Commands


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("check", help="who answers on the bus, and whether it is as described")
    parser.add_argument("robot", type=Path, metavar="ROBOT.toml")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print the findings as a table. A finding that forbids a session is an error."""
    from ..robot import load_robot, resolve
    from .checking import check, refusal, table

    robot = load_robot(options.robot)
    findings = check(robot, resolve(robot, str(options.robot)))
    print(*table(findings), sep="\n")
    if failed := refusal(findings):
        raise AcquisitionError(failed)
    print("go")
