"""`robot-identify friction`: choose friction terms by cross-validation."""

import argparse

from acquisition.commands import Progress, add_flag, add_options, add_path, from_options

from ..options import Overrides
from . import arguments as shared


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    shared.add_recordings(parser.add_argument_group("inputs"))
    add_options(
        parser.add_argument_group("settings of the fit"),
        Overrides,
        "cutoff_hz",
        "torque_lag_s",
        "gains",
    )
    outputs = parser.add_argument_group("outputs")
    add_path(
        outputs,
        "--json",
        "FILE",
        "write all tried sets of terms, and the selected one, as JSON",
    )
    shared.add_report(outputs)
    parser.set_defaults(all=True)
    add_flag(outputs, "--write", "write the selected terms to the description; requires --robot")


def run(options: argparse.Namespace) -> None:
    """Try sets of terms, print the table and the lines of robot.toml."""
    shared.COMMAND_LINE.require(
        options.robot or not options.write,
        "--write",
        text="requires --robot, the description to be changed",
    )
    shared.refuse_outputs(
        [*options.recordings, options.robot], json=options.json, report=options.report
    )
    with Progress("reading") as progress:
        from .. import data, design

        choice = design.select_friction(
            data.Recordings(sources=tuple(shared.sources(options))),
            from_options(Overrides, options),
            say=progress.say,
        )
    document = design.friction_document(choice)
    shared.show_results(
        options,
        document,
        lambda: design.friction_file(choice),
        lambda view: [view.draw_friction(*choice.fits(), document)],
    )
    if options.write:
        design.write_friction(options.robot, choice)
