"""Report and JSON file of a choice of friction terms, the lines of a description, friction over speed and load."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from acquisition.errors import AcquisitionError
from acquisition.files import atomic_write
from acquisition.robot import FrictionTerm, Robot, robot_from_files

from ..arrays import Array
from ..errors import IdentificationError
from ..methods import Fit, FittedRecording
from ..model import friction_alone
from ..regression import base_name, rigid_torque_at_rows
from ..report import Document, Number, ResultFile, Section, Table, columns
from .selection import TermChoice
from .trials import CANDIDATES, Trial, candidate_terms, described_terms

POINTS = 80  # of a curve, in each direction
LEVELS = (10.0, 50.0, 90.0)  # percentiles of the load at which curves are drawn
_TABLE = re.compile(r"^\s*\[(\[?)\s*([\w.\"'-]+)\s*\]")
_KEY = re.compile(r"^\s*(friction|viscous|coulomb|offset|stribeck_speed_deg_s|stribeck_speed_m_s)\s*=")
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
    first = choice.recordings[0]
    each = [{"recording": one.recording, "sha256": one.sha256} for one in choice.recordings]
    return FrictionFile(
        recording=first.recording,
        sha256=first.sha256,
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
                "lag_one": trial.lag_one,
                "condition_number_scaled": trial.condition_number_scaled,
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
    table = Table(
        columns=columns(
            "added terms",
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
    """A joint's line in robot.toml."""
    quoted = ", ".join(f'"{term}"' for term in terms)
    return f"friction = [{quoted}]"


def set_text(robot: Robot, trial: Trial) -> str:
    """A set in words, such as `root; load: joint_3`; without a joint's name, all joints have the term."""
    parts = []
    for term in CANDIDATES:
        able = [joint.name for joint in robot.joints if term in candidate_terms(joint)]
        own = [joint.name for joint, more in zip(robot.joints, trial.terms, strict=True) if term in more]
        if own:
            parts.append(term if own == able else f"{term}: {', '.join(own)}")
    return "; ".join(parts) or "none"


def write_friction(path: Path, terms: Lists, files: Mapping[str, bytes]) -> None:
    """Put the terms into the description at `path`.

    Raises `IdentificationError`: where the layout prevents replacing lines; the file is not changed.
    Raises `AcquisitionError`: where it cannot be read or written.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise AcquisitionError(f"cannot be read: {error}", place=str(path)) from error
    written = with_friction(text, tuple(terms.values()))
    try:
        robot = robot_from_files({**files, "robot.toml": written.encode()}, str(path))
        found = {joint.name: joint.friction for joint in robot.joints}
    except AcquisitionError:
        found = {}
    if found != terms:
        problem = "its lines of friction cannot be replaced"
        expected = "a table of its own for each joint, a key a line; copy the printed lines"
        raise IdentificationError(problem, place=str(path), key="[[joint]]", value=None, expected=expected)
    with atomic_write(path) as partial:
        partial.write_text(written, encoding="utf-8")


def with_friction(text: str, terms: Sequence[tuple[FrictionTerm, ...]]) -> str:
    """A description's text with these terms, joint by joint; the speed of removed Stribeck friction becomes a comment."""
    lines = text.splitlines(keepends=True)
    heads = [i for i, line in enumerate(lines) if _TABLE.match(line)]
    out, lists = lines[: heads[0] if heads else len(lines)], list(terms)
    for begin, end in pairwise([*heads, len(lines)]):
        section, head = lines[begin:end], _TABLE.match(lines[begin])
        of_joint = head is not None and head[1] == "[" and head[2] == "joint"
        out += _joint_section(section, lists.pop(0)) if of_joint and lists else section
    return "".join(out)


def _joint_section(section: list[str], terms: tuple[FrictionTerm, ...]) -> list[str]:
    """The lines of a joint; the list replaces its first line of friction, or follows its type."""
    out: list[str] = []
    place, depth = None, 0
    for line in section:
        key = _KEY.match(line) if depth == 0 else None
        if depth > 0 or (key and not key[1].startswith("stribeck")):  # lists may go over several lines
            code = line.split("#")[0]
            depth += code.count("[") - code.count("]")
            place = len(out) if place is None else place
        else:
            out.append(f"# {line}" if key and "stribeck" not in terms else line)
    if place is None:
        place = next((i for i, line in enumerate(out) if re.match(r"\s*type\s*=", line)), 0) + 1
    return [*out[:place], f"{friction_line(terms)}\n", *out[place:]]


@dataclass(frozen=True, kw_only=True, eq=False)
class FrictionCurve:
    """Friction of a joint at a load: `torque` (m,) over the speeds `speed` (m,), with half its 95 % interval, `half` (m,)."""

    load: float
    speed: Array
    torque: Array
    half: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class JointFriction:
    """Measured and identified friction of a joint, in the rows that count.

    Attributes:
        speed, torque, load: (k,) of the rows; torque is the measured one minus all other predicted torque (the offset too).
        curves: without load friction one, of load NaN; else at a low, a middle and a high load.
    """

    joint: str
    unit: str
    speed_unit: str
    speed: Array
    torque: Array
    load: Array
    curves: tuple[FrictionCurve, ...]


def friction_of_joints(fit: Fit) -> tuple[JointFriction, ...]:
    """Friction of each joint by a fit, in the rows of all its recordings; in the first rows of a long recording.

    If recordings have parameters of their own, rows use each recording's and the curve uses their means.
    """
    problem, robot, names = fit.problem, fit.problem.signals.robot, fit.estimate.names
    columns = problem.base.columns[[fit.base.names.index(base_name(name)) for name in names]]
    at_rows = [_rows_of(fit, one) for one in fit.recordings]
    moved, torques, residuals = (np.concatenate(x) for x in zip(*(one[:3] for one in at_rows), strict=True))
    applies = np.concatenate([np.tile(own, (len(dq), 1)) for dq, _, _, own in at_rows])  # (rows, b)
    mean = np.mean([own for *_, own in at_rows], axis=0)
    beta, covariance = fit.estimate.beta, fit.intervals.covariance
    joints = []
    for j, joint in enumerate(robot.joints):
        peak = np.abs(moved[:, j]).max(initial=0.0)
        rows = np.flatnonzero(np.abs(moved[:, j]) > 0.02 * peak)
        v, load = moved[rows, j], np.abs(torques[rows, j])
        friction = (friction_alone(problem.model, columns, j, v, load) * applies[rows]) @ beta
        loads = np.percentile(load, LEVELS) if "load" in joint.terms and len(load) else np.array([np.nan])
        speed = peak * np.r_[np.linspace(-1.0, -0.02, POINTS), np.linspace(0.02, 1.0, POINTS)]
        curves = []
        for level in loads:
            G = friction_alone(problem.model, columns, j, speed, np.full(len(speed), np.nan_to_num(level))) * mean
            half = fit.intervals.reach * np.sqrt(np.maximum(np.sum((G @ covariance) * G, axis=1), 0.0))
            curves.append(FrictionCurve(load=float(level), speed=speed, torque=G @ beta, half=half))
        joints.append(
            JointFriction(
                joint=joint.name,
                unit=robot.effort_units[j],
                speed_unit=f"{joint.position_unit}/s",
                speed=v,
                torque=friction + residuals[rows, j],
                load=load,
                curves=tuple(curves),
            )
        )
    return tuple(joints)


def _rows_of(fit: Fit, one: FittedRecording) -> tuple[Array, Array, Array, Array]:
    """Speeds, torques of the links and residuals (rows, n) of a recording, and which parameters (b,) it has."""
    dq, rigid = rigid_torque_at_rows(one.problem, one.parameters.values(fit.estimate))
    residual = (fit.tau - fit.tau_predicted)[one.rows][: len(dq)]
    return dq, rigid, residual, np.array([name in one.parameters.names for name in fit.estimate.names], dtype=float)
