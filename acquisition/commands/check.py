"""`robot-acquire check`: which drives answer, and whether they match the description; go or no go."""

import argparse

from ..errors import AcquisitionError
from .command_line import add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "robot", "ROBOT.toml")


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
