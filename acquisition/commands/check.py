"""`robot-acquire check`: who answers on the bus, and whether it is as described; go or no go."""

import argparse
from pathlib import Path

from ..errors import AcquisitionError, one_line
from .command_line import Commands


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("check", help="who answers on the bus, and whether it is as described")
    parser.add_argument("robot", type=Path, metavar="ROBOT.toml")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print the findings, one per line. A finding that forbids a session is an error."""
    from ..robot import load_robot, resolve
    from .checking import check

    robot = load_robot(options.robot)
    findings = check(robot, resolve(robot, str(options.robot)))
    for finding in findings:
        print(one_line(f"{'ok' if finding.ok else 'NO'}: {finding.subject}: {finding.found}"))
    failed = [finding.subject for finding in findings if not finding.ok]
    if failed:
        raise AcquisitionError(f"no go: {', '.join(dict.fromkeys(failed))}")
    print("go")
