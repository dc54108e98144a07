"""`robot-identify compare`: parameters of two fits side by side."""

import argparse
from pathlib import Path

from acquisition.commands import Commands

from .options import refuse_outputs
from .results import print_results


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("compare", help="parameters of two fits side by side")
    parser.add_argument("a", type=Path, metavar="A.json", help="a fit, as `fit --json` writes it")
    parser.add_argument("b", type=Path, metavar="B.json", help="another fit")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the comparison as JSON")
    parser.add_argument("--rrd", type=Path, metavar="FILE", help="write the comparison as a Rerun file")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print the differences, and what must be known of either fit."""
    from ..report import ParameterSet, comparison_document, comparison_file, frame_lines, read_fit, write_json

    refuse_outputs([options.a, options.b], options.json, options.rrd)
    same = options.a.stem == options.b.stem
    labels = [str(path) if same else path.stem for path in (options.a, options.b)]
    fits = [read_fit(path) for path in (options.a, options.b)]
    a, b = (ParameterSet.of_file(fit, label) for fit, label in zip(fits, labels, strict=True))
    warnings = [*fits[0].warnings_of(str(options.a)), *fits[1].warnings_of(str(options.b))]
    warnings += frame_lines(fits[0], fits[1], (labels[0], labels[1]))
    document = comparison_document(a, b, tuple(warnings))
    if options.json:
        write_json(options.json, comparison_file(a, b))
    if options.rrd:
        from ..view import write_comparison_rrd

        write_comparison_rrd(options.rrd, a, b)
    print_results(document)
