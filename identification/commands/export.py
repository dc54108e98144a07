"""`robot-identify export`: a fit as a model for simulators."""

import argparse
from pathlib import Path

from acquisition.commands import Commands, Progress

from ..errors import IdentificationError
from .options import refuse_outputs
from .results import print_results


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("export", help="a fit as URDF, MJCF or robot.toml, to simulate with")
    inputs = parser.add_argument_group("inputs")
    inputs.add_argument("fit", type=Path, metavar="FIT.json", help="the fit, as `fit --json` writes it")
    inputs.add_argument(
        "--allow-untrusted", action="store_true", help="export a fit with the verdict `do not use` all the same"
    )
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument(
        "--urdf", type=Path, metavar="OUT.urdf", help="the description's own URDF with new values, or a new one"
    )
    outputs.add_argument("--mjcf", type=Path, metavar="OUT.xml", help="a MuJoCo model")
    outputs.add_argument(
        "--toml", type=Path, metavar="OUT.toml", help="the description with the values in [parameters]"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Write the files asked for, and print what each format cannot say."""
    if options.urdf is None and options.mjcf is None and options.toml is None:
        raise IdentificationError("nothing to write", place="export", expected="--urdf, --mjcf or --toml with a file")
    refuse_outputs([options.fit], options.urdf, options.mjcf, options.toml)
    with Progress("reading"):
        from ..export import Outputs, distrust, export_model, model_of_fit
        from ..report import Section, read_fit

        stored, place = read_fit(options.fit), str(options.fit)
        reasons = distrust(stored, place)
        if reasons and not options.allow_untrusted:
            expected = "a fit to be trusted, or --allow-untrusted"
            raise IdentificationError(f"not exported: {'; '.join(reasons)}", expected=expected)
        outputs = Outputs(urdf=options.urdf, mjcf=options.mjcf, toml=options.toml)
        exported = export_model(model_of_fit(stored, place), outputs, options.fit.name)
        exported.write()
    warnings = Section(warnings=tuple(reasons)) if reasons else None
    print_results(exported.document.followed_by(warnings) if warnings else exported.document)
