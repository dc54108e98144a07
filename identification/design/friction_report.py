"""Report and JSON file of a choice of friction terms, and the lines of a description."""

from pathlib import Path
from typing import Any

import msgspec

from acquisition.files import atomic_write
from acquisition.robot import FrictionTerm, Robot

from ..export import replace_in_tables
from ..report import Document, Number, ResultFile, Section, Table, columns
from .selection import CANDIDATES, TermChoice, Trial, at_all_joints, described_terms

Lists = dict[str, tuple[FrictionTerm, ...]]  # by joint, as the list `friction` of a description


class FrictionFile(ResultFile, frozen=True, kw_only=True):
    """The JSON file of `friction`: all sets, best first, and the recommended terms by joint.

    Attributes:
        recording, sha256: of the first; `recordings` has both of all if there are several.
        held_out: names of the parts held out, in the order of `held_out_percents` of a set.
    """

    recording: str
    sha256: str
    recordings: list[dict[str, str]] | msgspec.UnsetType = msgspec.UNSET
    robot: str
    held_out: list[str]
    sets: list[dict[str, Any]]
    recommended: Lists
    left_out: list[str]


def friction_file(choice: TermChoice) -> FrictionFile:
    """The JSON file of a choice of terms; an error that does not exist is null."""
    each = [{"recording": one.recording, "sha256": one.sha256} for one in choice.recordings]
    return FrictionFile(
        recording=each[0]["recording"],
        sha256=each[0]["sha256"],
        recordings=each if len(each) > 1 else msgspec.UNSET,
        robot=choice.robot.name,
        held_out=list(choice.held_out),
        sets=[
            {
                "terms": described_terms(choice.robot, trial.terms),
                "added_terms": trial.count,
                "fitted_error_percent": trial.fitted_error_percent,
                "held_out_error_percent": trial.held_out_error_percent,
                "held_out_percents": trial.held_out_percents.tolist(),
                "score": trial.score,
            }
            for trial in choice.trials
        ],
        recommended=choice.described,
        left_out=list(choice.left_out),
    )


def friction_document(choice: TermChoice) -> Document:
    """The sets that were tried, best first, and the lines of robot.toml for the recommended one."""
    usual, chosen = choice.usual, choice.recommended
    errors = f"held-out error of moving rows {usual.held_out_error_percent:.2f} % with the usual terms"
    if chosen is not usual:
        errors += f", {chosen.held_out_error_percent:.2f} % with the recommended ones"
    heads = columns("added terms", numbers=("terms", "fitted %", "held out %", "score /\nusual")) + columns("")
    rows = tuple(
        (
            set_text(choice.robot, trial),
            Number(trial.count, "d"),
            Number(trial.fitted_error_percent, ".2f"),
            Number(trial.held_out_error_percent, ".2f"),
            Number(trial.score / usual.score if usual.score > 0 else None, ".3f"),
            "recommended" if trial is chosen else "usual" if trial is usual else "",
        )
        for trial in choice.trials
    )
    names = [one.recording for one in choice.recordings if one.recording in choice.held_out]  # in the order given
    held = f"held out: {', '.join(names) if len(choice.recordings) > 1 else 'fifths of the recording'}"
    held += ", each predicted by the fit of the others; score: squared weighted residual"
    sets = Section(
        title="sets of friction terms",
        table=Table(columns=heads, rows=rows),
        lines=(held,),
        warnings=choice.left_out,
    )
    lines = tuple(f"{friction_line(terms)} # {name}" for name, terms in choice.described.items())
    recommended = Section(title="recommended, for robot.toml", lines=lines)
    return Document(title=f"{choice.robot.name}: {errors}", sections=(sets, recommended))


def friction_line(terms: tuple[FrictionTerm, ...]) -> str:
    """A joint's line in robot.toml."""
    quoted = ", ".join(f'"{term}"' for term in terms)
    return f"friction = [{quoted}]"


def set_text(robot: Robot, trial: Trial) -> str:
    """A set in words, such as `root; load: joint_3`; without a joint's name, all joints have the term."""
    parts = []
    for term in CANDIDATES:
        able, own = at_all_joints(robot, [term]), [term in more for more in trial.terms]
        names = ", ".join(joint.name for joint, has in zip(robot.joints, own, strict=True) if has)
        if names:
            parts.append(term if own == list(map(bool, able)) else f"{term}: {names}")
    return "; ".join(parts) or "none"


def write_friction(path: Path, choice: TermChoice) -> None:
    """Put the recommended terms into the description at `path`, which is that of the choice; lines without use become comments.

    Raises `IdentificationError`: where the layout prevents replacing lines; the file is not changed.
    """
    values = dict[str, dict[str, Any]]()
    for joint, terms in zip(choice.robot.joints, choice.described.values(), strict=True):
        unused = ["viscous", "coulomb", "offset", *([] if "stribeck" in terms else [joint.key("stribeck_speed")])]
        values[joint.name] = {"friction": list(terms)} | dict.fromkeys(unused)
    written = replace_in_tables(choice.robot.files["robot.toml"].decode(), "joint", values, str(path))
    with atomic_write(path) as partial:
        partial.write_text(written, encoding="utf-8")
