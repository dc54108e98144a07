"""`robot-acquire check`: go/no-go for a recording and for motion.

The command shows which drives answer, and whether they match the description.
"""

import argparse

from ..errors import RefusedError
from ..options import RecordOptions
from .command_line import add_options, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "robot", "ROBOT.toml", "description of robot and drives")
    add_options(parser, RecordOptions, "payload")


def run(options: argparse.Namespace) -> None:
    """Print the verdicts, then all findings; a finding that forbids a session is an error."""
    from ..robot import load_robot, parse_payload, resolve
    from .checking import Finding, check, refusal, table, verdicts

    robot = load_robot(options.robot)
    payload = None if options.payload is None else parse_payload(options.payload, robot)
    findings = check(robot, resolve(robot, str(options.robot)))
    if payload is not None:
        findings.insert(0, Finding("payload", payload.describe(robot.joints[-1].name)))
    print(
        *(f"Check for {name} {verdict}." for name, verdict in verdicts(findings).items()),
        "",
        *table(findings),
        sep="\n",
    )
    if failed := refusal(findings):
        raise RefusedError(failed, what="motion")
