"""`robot-identify export`: a fit as a model for simulators."""

import argparse

from acquisition.commands import Progress, add_flag, add_path
from acquisition.errors import COMMAND_LINE, Location

from ..options import positive, whole
from .arguments import print_results, refuse_outputs


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "fit", "FIT.json", "fit that `fit --json` wrote")
    add_flag(inputs, "--allow-untrusted", "also export a fit with the verdict `do not use`")
    outputs = parser.add_argument_group("outputs")
    for option, metavar, text in (
        (
            "--urdf",
            "OUT.urdf",
            "write a URDF: that of the description with new values, or a new one",
        ),
        ("--mjcf", "OUT.xml", "write a MuJoCo model"),
        (
            "--toml",
            "OUT.toml",
            "write the description with the fitted [parameters] and drive gains",
        ),
    ):
        add_path(outputs, option, metavar, text)
    outputs.add_argument(
        "--draws",
        type=positive,
        metavar="N",
        help="also write N physically consistent models drawn from the intervals of the fit, as "
        "OUT_1.xml, OUT_2.xml, ...",
    )
    outputs.add_argument(
        "--seed", type=whole, metavar="K", help="seed of the draws (default: 1); requires --draws"
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
    COMMAND_LINE.require(
        options.draws or options.seed is None, "--seed", options.seed, text="requires --draws"
    )
    with Progress("reading") as progress:
        from .. import export, report

        document = export.export_fit(
            report.read_fit(options.fit),
            str(options.fit),
            untrusted=options.allow_untrusted,
            drawn=(options.draws or 0, 1 if options.seed is None else options.seed),
            say=progress.say,
            **outputs,
        )
    print_results(document, everything=False)
