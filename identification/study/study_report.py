"""The reports of robots with known parameters: base parameters, estimates against the true values, studies."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from acquisition.robot import Robot

from ..arrays import Array
from ..methods import Fit
from ..model import BaseParameters
from ..report import Document, Number, ResultFile, Row, Section, Table, columns, value_form
from .draws import Study
from .study import Run
from .summary import FALSE_ERROR, FALSE_TRUST, INSIDE, Summary, false_trust, study_json, summaries


class BaseParameter(msgspec.Struct, frozen=True, kw_only=True):
    """A base parameter, the sum of standard parameters it stands for, and its value where it is known."""

    name: str
    expression: str
    unit: str
    value: float | UnsetType = UNSET


class BaseFile(ResultFile, frozen=True, kw_only=True):
    """The JSON file of a robot's base parameters, or of the values that a recording was simulated with."""

    robot: str
    joint_names: list[str]  # joint number 1, 2, ..., which ends the names of parameters
    parameters: list[BaseParameter]


class StudyFile(ResultFile, frozen=True, kw_only=True):
    """The JSON file of a study: settings, names of the parameters, truth, summaries, every run."""

    study: dict[str, Any]
    parameters: list[str]
    true: list[float]
    summaries: list[dict[str, Any]]
    runs: list[dict[str, Any]]


def base_file(base: BaseParameters, robot: Robot, true: Array | None = None) -> BaseFile:
    """Base parameters as they go into their JSON file. Parameters as of `base_document`."""
    values: list[float | UnsetType] = [UNSET] * base.b if true is None else [float(x) for x in true]
    parameters = [
        BaseParameter(name=name, expression=expression, unit=unit, value=value)
        for name, expression, unit, value in zip(base.names, base.expressions, base.units, values, strict=True)
    ]
    return BaseFile(
        robot=robot.name,
        joint_names=[joint.name for joint in robot.joints],
        parameters=parameters,
    )


def study_file(study: Study, runs: Sequence[Run], base: BaseParameters, true: Array) -> StudyFile:
    """A study as it goes into its JSON file, `true` (b,) are the values of the parameters `base`."""
    return StudyFile(**study_json(study, runs, base.names, true))


def base_document(base: BaseParameters, robot: Robot, true: Array | None = None) -> Document:
    """The base parameters of a robot with the sums of standard parameters that they stand for, and its joints by number."""
    names = zip(base.names, base.expressions, base.units, strict=True)
    values: list[tuple[Number, ...]] = [()] * base.b if true is None else [(Number(float(x), ".6g"),) for x in true]
    table = Table(
        columns=columns("name", "expression", "unit", numbers=() if true is None else ("value",)),
        rows=tuple((*row, *value) for row, value in zip(names, values, strict=True)),
    )
    joints = Table(
        columns=columns("number", "joint", "type"),
        rows=tuple((str(j + 1), joint.name, joint.type) for j, joint in enumerate(robot.joints)),
    )
    sections = (Section(table=table), Section(title="joints, by the number that ends a name", table=joints))
    return Document(title=f"{robot.name}: {base.b} base parameters", sections=sections)


def truth_document(robot: str, fits: Sequence[Fit], true: Array) -> Document:
    """Estimates beside the values that a recording was simulated with.

    Each has half its 95 % interval, and by how many of these halves it is off.
    """
    halves = [fit.intervals.half for fit in fits]
    rows: list[Row] = []
    for i, name in enumerate(fits[0].base.names):
        form = value_form(float(min(half[i] for half in halves)) / 2)
        cells: list[Number] = []
        for fit, half in zip(fits, halves, strict=True):
            off = float((fit.beta[i] - true[i]) / half[i]) if half[i] > 0 else None
            cells += [Number(float(fit.beta[i]), form), Number(float(half[i]), form), Number(off, "+.2f")]
        rows.append((name, Number(float(true[i]), form), *cells))
    lines = []
    for fit, half in zip(fits, halves, strict=True):
        within = int((np.abs(fit.beta - true) <= half).sum())
        error = 100 * np.linalg.norm(fit.beta - true) / np.linalg.norm(true)
        lines.append(
            f"{fit.method}: {within} of {len(true)} in their 95 % interval; |beta - true| = {error:.2f} % of |true|"
        )
    headings = (heading for fit in fits for heading in (fit.method, "±95%", "off by,\n±95%"))
    table = Table(columns=columns("parameter", numbers=("true", *headings)), rows=tuple(rows))
    return Document(
        title=f"{robot}: {len(true)} estimated parameters and their true values",
        sections=(Section(title="against the values simulated with", table=table, lines=tuple(lines)),),
    )


def study_document(robot: str, study: Study, runs: Sequence[Run], true: Array) -> Document:
    """A study's summaries, one row per cut-off and method, and what it varied."""
    rows = summaries(runs, true)
    percents = ("bias %", "spread %", "median error %", "worst error %")
    shares = ("sigma / spread", "converged %", "passes", "false %")
    estimates = Table(
        columns=columns("cut-off", "method", numbers=("runs", *percents, *shares)),
        rows=tuple(
            (
                *_of(s),
                Number(s.runs, "d"),
                Number(s.bias_percent, ".3f"),
                Number(s.spread_percent, ".3f"),
                Number(s.median_error_percent, ".3f"),
                Number(s.worst_error_percent, ".3f"),
                Number(s.sigma_over_spread, ".2f"),
                *("" if x is None else Number(x, ".1f") for x in (s.converged_percent, s.mean_passes, s.false_percent)),
            )
            for s in rows
        ),
    )
    counts = ("fits", "trust", "false trust", "clean", "false caution")
    trust = Table(
        columns=columns("cut-off", "method", numbers=("coverage %", "half-width /\n1.96 spread", *counts)),
        rows=tuple(
            (
                *_of(s),
                Number(s.coverage_percent, ".1f"),
                Number(s.half_over_spread, ".2f"),
                *(Number(x, "d") for x in (s.verdicts, s.trusted, s.false_trust, s.clean, s.false_caution)),
            )
            for s in rows
        ),
    )
    return Document(
        title=f"{robot}: {len(runs)} runs",
        sections=(
            Section(table=estimates, lines=study_notes(study)),
            Section(title="intervals and verdicts", table=trust, lines=trust_notes(runs, true)),
        ),
    )


def _of(summary: Summary) -> tuple[str, str]:
    return f"{summary.cutoff:g} x bandwidth" if summary.cutoff else "none", summary.method


def trust_notes(runs: Sequence[Run], true: Array) -> tuple[str, ...]:
    """What the verdicts' columns count, and the runs that say `trust` and should not."""
    found = {
        method: [r.number for r in runs if (judged := getattr(r, kind)) is not None and false_trust(judged, true)]
        for method, kind in (("wls", "ls"), ("iv", "iv"))
    }
    listed = "; ".join(f"{method}: {', '.join(map(str, numbers))}" for method, numbers in found.items() if numbers)
    return (
        "coverage %: true values inside the printed 95 % intervals, all parameters; of runs of iv, those that converged",
        f"false trust: verdict trust though an essential parameter is more than {FALSE_TRUST:g} half-widths off, or M not "
        f"positive: {f'runs {listed}' if listed else 'no run'}",
        "clean: the fit is told all but the noise, and every essential parameter is inside "
        f"{INSIDE:g} half-widths; false caution: of these, a test says caution or worse (tests not made apart)",
    )


def study_notes(study: Study) -> tuple[str, str]:
    """What was simulated and varied, and what `false %` counts."""
    noise = study.noise

    def listed(values: Sequence[float]) -> str:
        return ", ".join(f"{x:g}" if x else "none" for x in values)

    given = noise.text
    cell = (
        f"imperfections of all kinds, encoder step about {noise.encoder_step:g}"
        if study.vary == "everything"
        else given
    )
    told = "described, designed, none" if study.vary == "everything" else ", ".join(study.controllers)
    return (
        f"{study.runs} runs of {study.duration_s:g} s at {study.sample_rate_hz:g} Hz, seed {study.seed}; cell: {cell}; torque "
        f"recorded as {'either' if study.vary == 'everything' else noise.recorded}; drawn by "
        f"each run: cut-off {listed(study.cutoffs)} x bandwidth, start {listed(study.starts)} x true inertia, gains "
        f"{listed(study.gain_errors)} x true, controller {told}",
        "false %: runs called converged that should not be: their inertia matrix is not positive, or they are off by more than "
        f"{FALSE_ERROR:g} times what least squares at the rule's cut-off is on the same recording",
    )
