"""`robot-identify base`: base parameters of a robot, with their expressions."""

import argparse
from pathlib import Path

from acquisition.commands import Commands, Progress

from .options import refuse_outputs
from .results import print_results
from .robots import add_robot, robot_of


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("base", help="base parameters of a robot, with their expressions")
    add_robot(parser, "its geometry and joints")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the parameters as JSON")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print the base parameters."""
    refuse_outputs([options.robot], options.json)
    with Progress("base parameters"):
        from ..model import InverseModel, base_parameters
        from ..report import write_json
        from ..study import base_document, base_file

        robot = robot_of(options)
        base = base_parameters(InverseModel(robot))
    if options.json:
        write_json(options.json, base_file(base, robot))
    print_results(base_document(base, robot))
