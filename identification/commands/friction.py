"""`robot-identify friction`: which friction terms predict a recording."""

import argparse
from pathlib import Path

from acquisition.commands import Commands, Progress, from_options

from ..errors import IdentificationError
from .options import add_recording, add_settings, refuse_outputs, share, sources
from .results import print_results


def add(commands: Commands) -> None:
    """Declare the command; its settings have the names of the fields of `Overrides`."""
    parser = commands.add_parser(
        "friction", help="which friction terms predict parts of a recording, or recordings, held out"
    )
    add_recording(parser)
    settings = add_settings(parser)
    settings.add_argument("--low-speed-percent", type=share, metavar="P", help="as for fit")
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("--json", type=Path, metavar="FILE", help="write all sets and the recommended terms as JSON")
    outputs.add_argument(
        "--rrd", type=Path, metavar="FILE", help="draw friction over speed, with the usual and the recommended terms"
    )
    outputs.add_argument("--write", action="store_true", help="put the recommended terms into the file of --robot")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Try sets of terms, print the table and the lines of robot.toml."""
    if options.write and options.robot is None:
        raise IdentificationError(key="--write", value=True, expected="--robot with it, the description to write to")
    refuse_outputs([*options.recordings, options.robot], options.json, picture=options.rrd)
    with Progress("reading") as progress:
        from ..data import Recordings
        from ..design import choose_terms, fits_with, friction_document, friction_file, write_friction
        from ..regression import Overrides
        from ..report import write_json

        overrides = from_options(Overrides, options)
        choice = choose_terms(Recordings(sources=tuple(sources(options))), overrides, say=progress.say)
    document = friction_document(choice)
    try:
        if options.json:
            write_json(options.json, friction_file(choice))
        if options.rrd:
            with Progress("writing the Rerun file"):
                from ..view import write_friction_rrd

                before, after = fits_with(choice, overrides)
                write_friction_rrd(options.rrd, before, after, document)
        if options.write:
            write_friction(options.robot, choice.described, choice.robot.files)
    finally:  # print the result even if a file cannot be written
        print_results(document)
