"""`robot-identify base`: base parameters of a robot, with their expressions."""

import argparse

from acquisition.commands import Progress, add_flag, add_path

from .arguments import add_robot, refuse_outputs, show_results


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser, "needs joints and their geometry")
    add_flag(parser, "--all", "print all parameters, not only the regrouped ones")
    add_path(parser, "--json", "FILE", "write the parameters as JSON")


def run(options: argparse.Namespace) -> None:
    """Print the base parameters."""
    refuse_outputs([options.robot], json=options.json)
    with Progress("base parameters"):
        from acquisition.robot import load_robot

        from .. import model, study

        robot = load_robot(options.robot)
        base = model.base_parameters(model.InverseModel(robot))
    show_results(options, study.base_document(base, robot), lambda: study.base_file(base, robot))
