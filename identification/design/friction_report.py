"""Report and JSON file of a selection of friction terms, and its lines in a description."""

import json
from pathlib import Path
from typing import Any

from acquisition.files import write_text
from acquisition.robot import Robot

from ..export import replace_in_tables
from ..report import Document, Number, Section, Table, columns
from .selection import CANDIDATES, TermChoice, TermSet, at_all_joints, described_terms


def friction_file(choice: TermChoice) -> dict[str, Any]:
    """Make the content of the JSON file: all sets, best first, and the selected terms by joint.

    `recording` and `sha256` are those of the first of several `recordings`; `held_out` names the
    parts of `held_out_percents`. An error that does not exist is null.

    Parameters
    ----------
    choice : the sets that were tried, and the selected one.
    """
    each = [{"recording": one.recording, "sha256": one.sha256} for one in choice.recordings]
    return {
        **each[0],
        **({"recordings": each} if len(each) > 1 else {}),
        "robot": choice.robot.name,
        "held_out": choice.held_out,
        "sets": [
            {"terms": described_terms(choice.robot, trial.terms)}
            | {
                key: getattr(trial, key)
                for key in (
                    "added_terms",
                    "fitted_error_percent",
                    "held_out_error_percent",
                    "held_out_percents",
                    "score",
                )
            }
            for trial in choice.trials
        ],
        "recommended": choice.described,
        "left_out": choice.left_out,
    }


def friction_document(choice: TermChoice) -> Document:
    """Make the report of the sets that were tried, with the selected lines of robot.toml.

    Parameters
    ----------
    choice : the sets that were tried, and the selected one.
    """
    usual, chosen = choice.usual, choice.recommended
    errors = f"held-out torque error {usual.held_out_error_percent:.2f} % with the usual terms" + (
        f", {chosen.held_out_error_percent:.2f} % with the selected ones"
        if chosen is not usual
        else ""
    )
    table = Table(
        columns=(
            *columns(
                "added terms", numbers=("number", "fitted, %", "held out, %", "relative\nscore")
            ),
            *columns(""),
        ),
        rows=tuple(
            (
                set_text(choice.robot, trial.terms),
                Number(trial.added_terms, "d"),
                Number(trial.fitted_error_percent, ".2f"),
                Number(trial.held_out_error_percent, ".2f"),
                Number(trial.score / usual.score if usual.score > 0 else None, ".3f"),
                "selected" if trial is chosen else "usual" if trial is usual else "",
            )
            for trial in choice.trials
        ),
    )
    # In the order given, without the recordings that could not be predicted.
    names = [one.recording for one in choice.recordings if one.recording in choice.held_out]
    return Document(
        title=f"{choice.robot.name}: {errors}",
        sections=(
            Section(
                title="sets of friction terms",
                table=table,
                lines=(
                    f"held out: {', '.join(names) or 'fifths of the recording'}, each predicted by "
                    "the fit of the others",
                    "relative score: sum of squared weighted residuals, divided by that of the "
                    "usual terms",
                ),
                warnings=choice.left_out,
            ),
            Section(
                title="selected terms, for robot.toml",
                lines=tuple(
                    f"friction = {json.dumps(terms)} # {name}"
                    for name, terms in choice.described.items()
                ),
            ),
        ),
    )


def set_text(robot: Robot, terms: TermSet) -> str:
    """Return a set in words, such as `root; load: joint_3`.

    A term without joints belongs to all joints that can have it.
    """
    parts = []
    for term in CANDIDATES:
        if having := [
            joint.name for joint, more in zip(robot.joints, terms, strict=True) if term in more
        ]:
            everywhere = len(having) == sum(map(len, at_all_joints(robot, [term])))
            parts.append(term if everywhere else f"{term}: {', '.join(having)}")
    return "; ".join(parts) or "none"


def write_friction(path: Path, choice: TermChoice) -> None:
    """Write the selected terms into the description that the selection used.

    Lines of other friction terms become comments.

    Parameters
    ----------
    path : file of the description.
    choice : the sets that were tried, and the selected one.
    """
    values: dict[str, dict[str, Any]] = {
        joint.name: {
            "friction": list(terms),
            **dict.fromkeys(("viscous", "coulomb", "offset")),
            **({} if "stribeck" in terms else {joint.key("stribeck_speed"): None}),
        }
        for joint, terms in zip(choice.robot.joints, choice.described.values(), strict=True)
    }
    write_text(
        path,
        replace_in_tables(choice.robot.files["robot.toml"].decode(), "joint", values, str(path)),
    )
