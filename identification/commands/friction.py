"""`robot-identify friction`: choose friction terms by cross-validation."""

import argparse

from acquisition.commands import Progress, add_flag, add_options, add_path, from_options

from ..errors import BadInputError
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
        "write all sets of terms that were tried, and the recommended one, as JSON",
    )
    shared.add_report(outputs)
    parser.set_defaults(all=True)
    add_flag(outputs, "--write", "write the recommended terms into the file of --robot")


def run(options: argparse.Namespace) -> None:
    """Try sets of terms, print the table and the lines of robot.toml."""
    if options.write and options.robot is None:
        raise BadInputError(
            key="--write", value=True, expected="--robot with it, the description to write to"
        )
    shared.refuse_outputs(
        [*options.recordings, options.robot], json=options.json, report=options.report
    )
    with Progress("reading") as progress:
        from ..data import Recordings
        from ..design import friction_document, friction_file, select_friction, write_friction

        choice = select_friction(
            Recordings(sources=tuple(shared.sources(options))),
            from_options(Overrides, options),
            say=progress.say,
        )
    document = friction_document(choice)
    shared.show_results(
        options,
        document,
        lambda: friction_file(choice),
        lambda view: [view.draw_friction(*choice.fits(), document)],
    )
    if options.write:
        write_friction(options.robot, choice)
