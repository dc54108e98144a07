"""`robot-identify base`: base parameters of a robot, with their expressions."""

import argparse
from pathlib import Path

from acquisition.commands import Commands, Progress

from .options import refuse_outputs
from .results import print_results


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("base", help="base parameters of a robot, with their expressions")
    parser.add_argument("robot", type=Path, metavar="ROBOT.toml", help="the robot's description")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the parameters as JSON")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print the base parameters."""
    refuse_outputs([options.robot], options.json)
    with Progress("base parameters"):
        from acquisition.robot import load_robot

        from ..model import InverseModel, base_parameters
        from ..report import base_document, base_file, write_json

        robot = load_robot(options.robot)
        base = base_parameters(InverseModel(robot))
    if options.json:
        write_json(options.json, base_file(base, robot.name))
    print_results(base_document(base, robot.name))
