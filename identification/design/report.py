"""The report of a choice of friction terms, its JSON file, and the lines of a description."""

import msgspec

from acquisition.robot import FrictionTerm, Robot

from ..report import Document, Number, ResultFile, Section, Table, columns
from .selection import TermChoice
from .sets import TRIED, described_terms, tried_terms
from .trials import Trial

Lists = dict[str, tuple[FrictionTerm, ...]]  # by joint, as the list `friction` of a description


class TermSetFile(msgspec.Struct, frozen=True, kw_only=True):
    """A set of terms: by joint, its size beside the usual terms, its errors in percent of moving rows, its fit."""

    terms: Lists
    added_terms: int
    fitted_error_percent: float | None
    held_out_error_percent: float | None
    held_out_percents: list[float | None]
    score: float
    lag_one: float | None
    condition_number_scaled: float


class RecordingOfChoice(msgspec.Struct, frozen=True, kw_only=True):
    """One of several recordings."""

    recording: str
    sha256: str


class FrictionFile(ResultFile, frozen=True, kw_only=True):
    """The JSON file of `friction`: all sets, best first, and the recommended terms by joint.

    Attributes:
        recording, sha256: of the first; `recordings` are all, where they are several.
        held_out: names of the parts held out, which `held_out_percents` of a set are of.
    """

    recording: str
    sha256: str
    recordings: list[RecordingOfChoice] | msgspec.UnsetType = msgspec.UNSET
    robot: str
    held_out: list[str]
    sets: list[TermSetFile]
    recommended: Lists
    left_out: list[str]


def friction_file(choice: TermChoice) -> FrictionFile:
    """A choice of terms as it goes into its JSON file; an error that does not exist is null."""
    names, first = [joint.name for joint in choice.robot.joints], choice.recordings[0]
    each = [RecordingOfChoice(recording=one.recording, sha256=one.sha256) for one in choice.recordings]
    return FrictionFile(
        recording=first.recording,
        sha256=first.sha256,
        recordings=each if len(each) > 1 else msgspec.UNSET,
        robot=choice.robot.name,
        held_out=list(choice.held_out),
        sets=[
            TermSetFile(
                terms=dict(zip(names, described_terms(choice.robot, trial.terms), strict=True)),
                added_terms=trial.count,
                fitted_error_percent=Number(trial.fitted_error_percent).exact,
                held_out_error_percent=Number(trial.held_out_error_percent).exact,
                held_out_percents=[Number(float(x)).exact for x in trial.held_out_percents],
                score=trial.score,
                lag_one=trial.lag_one,
                condition_number_scaled=trial.condition_number_scaled,
            )
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
    table = Table(
        columns=columns(
            "beside the usual terms",
            numbers=("terms", "fitted %", "held out %", "score /\nusual", "residual lag-1", "cond(W)"),
        )
        + columns(""),
        rows=tuple(
            (
                set_text(choice.robot, trial),
                Number(trial.count, "d"),
                Number(trial.fitted_error_percent, ".2f"),
                Number(trial.held_out_error_percent, ".2f"),
                Number(trial.score / usual.score if usual.score > 0 else None, ".3f"),
                Number(trial.lag_one, ".2f"),
                Number(trial.condition_number_scaled, ".1f"),
                "recommended" if trial is chosen else "usual" if trial is usual else "",
            )
            for trial in choice.trials
        ),
    )
    names = [one.recording for one in choice.recordings if one.recording in choice.held_out]  # in the order given
    held = f"held out: {', '.join(names) if len(choice.recordings) > 1 else 'fifths of the recording'}"
    held += ", each predicted by the fit of the others; score: squared weighted residual"
    lines = tuple(f"{friction_line(terms)} # {name}" for name, terms in choice.described.items())
    return Document(
        title=f"{choice.robot.name}: {errors}",
        sections=(
            Section(title="sets of friction terms", table=table, lines=(held,), warnings=choice.left_out),
            Section(title="recommended, for robot.toml", lines=lines),
        ),
    )


def friction_line(terms: tuple[FrictionTerm, ...]) -> str:
    """The line of a joint in robot.toml."""
    quoted = ", ".join(f'"{term}"' for term in terms)
    return f"friction = [{quoted}]"


def set_text(robot: Robot, trial: Trial) -> str:
    """A set in words, such as `root; load: joint_3`: where no joint is named, all of them have the term."""
    parts = []
    for term in TRIED:
        able = [joint.name for joint in robot.joints if term in tried_terms(joint)]
        own = [joint.name for joint, more in zip(robot.joints, trial.terms, strict=True) if term in more]
        if own:
            parts.append(term if own == able else f"{term}: {', '.join(own)}")
    return "; ".join(parts) or "none"
