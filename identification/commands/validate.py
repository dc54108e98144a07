"""`robot-identify validate`: torque error of a fit on other recordings."""

import argparse
from hashlib import sha256

from acquisition.commands import Progress, add_flag, add_options, add_path, from_options
from acquisition.errors import Location

from ..options import Overrides, above_zero
from . import arguments as shared


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "fit", "FIT.json", "fit that `fit --json` wrote")
    shared.add_recordings(inputs)
    add_options(
        parser.add_argument_group(
            "settings of the fit", "The settings in FIT.json replace the defaults below."
        ),
        Overrides,
        "torque_lag_s",
    )
    outputs = parser.add_argument_group("outputs")
    add_path(outputs, "--json", "FILE", "write the errors as JSON")
    shared.add_report(outputs)
    outputs.add_argument(
        "--max-error-percent",
        type=above_zero,
        metavar="P",
        help="exit with status 3 if the torque error (with --consistent: of the consistent set) is "
        "greater than P %%",
    )
    parser.set_defaults(all=False)
    add_flag(
        parser, "--consistent", "also validate the physically consistent parameters of the fit"
    )


def run(options: argparse.Namespace) -> int:
    """Print the torque errors of the fit; 3 if they are larger than allowed."""
    *others, last = map(str, (options.fit, *options.recordings))
    Location(str(options.fit)).require(
        options.fit.suffix == ".json" or options.recordings[-1].suffix != ".json",
        text="is not a fit",
        advice=f"Pass the fit first: `robot-identify validate {last} {' '.join(others)}`",
    )
    shared.refuse_outputs(
        [options.fit, *options.recordings, options.robot],
        json=options.json,
        report=options.report,
    )
    with Progress("reading") as progress:
        from .. import report, results

        place, name, stored = str(options.fit), options.fit.name, report.read_fit(options.fit)
        consistent = results.consistent_fit(stored, place) if options.consistent else None
        pairs = [
            (source.load(), path)
            for path, source in zip(options.recordings, shared.sources(options), strict=True)
        ]
        given, chosen = from_options(Overrides, options), options.robot is not None
        progress.say("predicting")
        validated, errors, warnings = results.predict_recordings(
            stored, place, pairs, given, chosen=chosen
        )
        of_set = (
            ()
            if consistent is None
            else results.predict_recordings(
                consistent, place, pairs, given, chosen=chosen, ahead=False
            )[1]
        )
    document = results.validation_document(validated, name, errors, warnings, of_set)
    digests = {name: sha256(options.fit.read_bytes()).hexdigest()}
    shared.show_results(
        options,
        document,
        lambda: results.validation_file(validated, name, errors, warnings, of_set),
        lambda view: [view.draw_validation(validated, document, digests)],
    )
    return _status(options, (of_set or errors)[-1].relative_error_percent)


def _status(options: argparse.Namespace, error: float | None) -> int:
    """Return 3 if an error in percent is above `--max-error-percent`."""
    limit = options.max_error_percent
    if limit is None or (error is not None and error <= limit):
        return 0
    found = "no torque to compare with" if error is None else f"relative torque error {error:.4g} %"
    return shared.trust_status(
        [
            f"{options.fit} on {', '.join(map(str, options.recordings))}: {found}: expected at "
            f"most {limit:g} %"
        ]
    )
