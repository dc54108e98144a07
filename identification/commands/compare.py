"""`robot-identify compare`: the parameters of two fits, or of a fit and a prior."""

import argparse
from hashlib import sha256

from acquisition.commands import add_flag, add_path

from .arguments import add_report, refuse_outputs, show_results


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "a", "A.json", "fit that `fit --json` wrote")
    add_path(
        parser,
        "b",
        "B.json|URDF",
        "another fit; or a URDF or robot.toml with a priori link parameters",
    )
    add_path(parser, "--json", "FILE", "write the comparison as JSON")
    add_flag(parser, "--all", "print all parameters, not only the largest differences")
    add_report(parser)


def run(options: argparse.Namespace) -> None:
    """Print the differences, and the warnings of both fits."""
    from ..report import ParameterSet, comparison_document, differences, frame_lines, read_fit

    paths, prior = (options.a, options.b), options.b.suffix.lower() in (".urdf", ".toml")
    refuse_outputs(paths, json=options.json, report=options.report)
    first = read_fit(options.a)
    if prior:
        from ..results import prior_file

    second = prior_file(first, str(options.a), options.b) if prior else read_fit(options.b)
    names = [str(path) if options.a.stem == options.b.stem else path.stem for path in paths]
    a, b = ParameterSet.of_file(first, names[0]), ParameterSet.of_file(second, names[1])
    document = comparison_document(
        a,
        b,
        (
            *first.warnings_of(str(options.a)),
            *second.warnings_of(str(options.b)),
            *frame_lines(first, second, (a.label, b.label)),
        ),
        prior=prior,
    )
    digests = {str(path): sha256(path.read_bytes()).hexdigest() for path in paths}
    show_results(
        options,
        document,
        lambda: {"a": a.label, "b": b.label, "differences": differences(a, b)},
        lambda view: [view.draw_comparison(a, b, document, digests)],
    )
