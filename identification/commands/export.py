"""`robot-identify export`: a fit as a model for simulators."""

import argparse

from acquisition.commands import Progress, add_flag, add_path
from acquisition.errors import Location

from .arguments import print_results, refuse_outputs


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "fit", "FIT.json", "fit that `fit --json` wrote")
    add_flag(inputs, "--allow-untrusted", "also export a fit with the verdict `do not use`")
    outputs = parser.add_argument_group("outputs")
    add_path(
        outputs,
        "--urdf",
        "OUT.urdf",
        "write a URDF: that of the description with new values, or a new one",
    )
    add_path(outputs, "--mjcf", "OUT.xml", "write a MuJoCo model")
    add_path(
        outputs,
        "--toml",
        "OUT.toml",
        "write the description with the fitted [parameters] and drive gains",
    )


def run(options: argparse.Namespace) -> None:
    """Write the requested files, and print what each format cannot represent."""
    outputs = {"urdf": options.urdf, "mjcf": options.mjcf, "toml": options.toml}
    Location("export").require(
        any(outputs.values()),
        text="no output file is given",
        advice="Add --urdf, --mjcf or --toml with a file",
    )
    refuse_outputs([options.fit], **outputs)
    with Progress("reading"):
        from .. import export, report

        document = export.export_fit(
            report.read_fit(options.fit),
            str(options.fit),
            untrusted=options.allow_untrusted,
            **outputs,
        )
    print_results(document, everything=False)
