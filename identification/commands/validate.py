"""`robot-identify validate`: apply a fit to other recordings."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from acquisition.commands import Commands, Progress, from_options

from .options import above_zero, add_recording, add_settings, load, refuse_outputs
from .results import print_results, untrusted

if TYPE_CHECKING:
    from ..data import Signals
    from ..estimation import TorqueError
    from ..report import FitFile


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser("validate", help="apply a fit to other recordings")
    add_recording(parser, "fit")
    add_settings(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("--json", type=Path, metavar="FILE", help="write the errors as JSON")
    outputs.add_argument(
        "--max-error-percent",
        type=above_zero,
        metavar="P",
        help="exit status 3 if the torque error of all rows is larger, with --consistent that of the consistent set",
    )
    parser.add_argument(
        "--consistent", action="store_true", help="the physically consistent set of the fit too, beside the fit itself"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the torque errors of the fit on the recording; 3 when they are larger than allowed."""
    refuse_outputs([options.fit, *options.recordings, options.robot], options.json)
    with Progress("reading") as progress:
        from ..methods import (
            consistent_fit,
            stored_beta,
            stored_settings,
            validate_all,
            validation_document,
            validation_file,
        )
        from ..regression import Overrides
        from ..report import read_fit, write_json

        stored, recordings, notes = read_fit(options.fit), [], []
        consistent = consistent_fit(stored, str(options.fit)) if options.consistent else None
        for path, own in zip(options.recordings, load(options), strict=True):
            signals, told = as_fitted(own, path, stored, str(options.fit), chosen=options.robot is not None)
            overrides = from_options(Overrides, options).over(stored_settings(stored, signals))
            recordings.append((signals, overrides))
            notes += told
        progress.say("predicting")
        validated, errors = validate_all(recordings, lambda base: stored_beta(stored, base, str(options.fit)))
        of_set: tuple[TorqueError, ...] = ()
        if consistent is not None:
            _, of_set = validate_all(recordings, lambda base: stored_beta(consistent, base, str(options.fit)))
    of_settings = dict.fromkeys(text for one in validated for text in one.settings.warnings)
    warnings = (*of_settings, *notes, *stored.warnings_of(str(options.fit)))
    document = validation_document(validated, options.fit.name, errors, warnings, of_set)
    if options.json:
        write_json(options.json, validation_file(validated, options.fit.name, errors, warnings, of_set))
    print_results(document)
    error, most = (of_set or errors)[-1].relative_error_percent, options.max_error_percent
    if most is None or (error is not None and error <= most):
        return 0
    found = "no torque to compare with" if error is None else f"relative torque error {error:.4g} %"
    on = ", ".join(map(str, options.recordings))
    return untrusted([f"{options.fit} on {on}: {found}: expected at most {most:g} %"])


def as_fitted(
    signals: "Signals", recording: Path, stored: "FitFile", place: str, *, chosen: bool
) -> tuple["Signals", list[str]]:
    """The signals of a recording, by the fit's own description where the parameters are not those of the recording's.

    `chosen`: the user gave the description. The lines say what a reader must know; `place` names the fit in them.
    """
    from ..data import load_signals
    from ..methods import other_meaning, stored_robot
    from ..model import InverseModel, base_parameters

    other = other_meaning(stored, base_parameters(InverseModel(signals.robot)))
    if not other:
        return signals, []
    names = ", ".join(other[:5]) + (", ..." if len(other) > 5 else "")
    robot = None if chosen else stored_robot(stored, place)
    if robot is None:
        return signals, [
            f"{place}: {names}: perhaps not the same quantities as those of robot {signals.robot.name} here"
        ]
    note = f"{signals.recording}: its description does not have the parameters of the fit ({names}): that of {place} is used"
    return load_signals(recording, robot), [note]
