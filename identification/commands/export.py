"""`robot-identify export`: a fit as a model for simulators."""

import argparse

from acquisition.commands import Progress, add_flag, add_path

from ..errors import BadInputError
from .arguments import print_results, refuse_outputs


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "fit", "FIT.json", "the fit, as `fit --json` writes it")
    add_flag(inputs, "--allow-untrusted", "also export a fit with the verdict `do not use`")
    outputs = parser.add_argument_group("outputs")
    add_path(
        outputs, "--urdf", "OUT.urdf", "the description's own URDF with new values, or a new one"
    )
    add_path(outputs, "--mjcf", "OUT.xml", "a MuJoCo model")
    add_path(
        outputs,
        "--toml",
        "OUT.toml",
        "the description with the fitted [parameters] and drive gains",
    )


def run(options: argparse.Namespace) -> None:
    """Write the requested files, and print what each format cannot represent."""
    if options.urdf is None and options.mjcf is None and options.toml is None:
        raise BadInputError(
            "nothing to write", place="export", expected="--urdf, --mjcf or --toml with a file"
        )
    refuse_outputs([options.fit], urdf=options.urdf, mjcf=options.mjcf, toml=options.toml)
    with Progress("reading"):
        from ..export import export_fit
        from ..report import read_fit

        document = export_fit(
            read_fit(options.fit),
            str(options.fit),
            untrusted=options.allow_untrusted,
            urdf=options.urdf,
            mjcf=options.mjcf,
            toml=options.toml,
        )
    print_results(document, everything=False)
