"""Summaries, report and file of a study; report and file of base parameters."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array
from ..model import BaseParameters, InverseModel, known_parameters
from ..report import PER_INTERVAL, Document, Number, Section, Table, columns
from .study import Run, RunFit, Study

FALSE_TRUST = 3.0  # half-widths: largest error of an essential parameter for `trust`
METHODS = (("wls", "ls"), ("iv", "iv"))  # and the field of a `Run`
# Headings and formats of the fields of a `Summary`, in their order.
HEADINGS = ("runs", "bias %", "coverage %", "spread /\ninterval", "trust", "false trust")
FORMATS = ("d", ".3f", ".1f", ".2f", "d", "d")


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary:
    """Runs by one method: of wls those with an estimate, of iv those that converged.

    NaN if there are none.

    Attributes:
        bias_percent: norm of the mean error over all parameters, in percent of the
            norm of the true ones.
        coverage_percent: true values inside their 95 % intervals, over all parameters.
        spread_over_interval: median over the parameters of 1.96 observed
            deviations over the half-width.
        trusted, false_trust: runs with the verdict `trust`; those of them in which an essential
            parameter is more than `FALSE_TRUST` half-widths off or M is not positive.
    """

    method: str
    runs: int
    bias_percent: float
    coverage_percent: float
    spread_over_interval: float
    trusted: int
    false_trust: int


def summaries(runs: Sequence[Run], true: Array) -> list[Summary]:
    """One summary per method; `true` (b,) are the values simulated with."""
    rows = []
    for method, kind in METHODS:
        fits = [
            fit
            for r in runs
            if (fit := getattr(r, kind)) and (method == "wls" or r.status == "converged")
        ]
        beta, low, high = (
            np.array([getattr(x, k) for x in fits] or [true * np.nan])
            for k in ("beta", "low", "high")
        )
        spread = beta.std(axis=0, ddof=1) if len(fits) > 1 else true * np.nan
        inside = [fit.half_widths_off(true) <= 1 for fit in fits]
        rows.append(
            Summary(
                method=method,
                runs=len(fits),
                bias_percent=float(
                    100 * np.linalg.norm(beta.mean(axis=0) - true) / np.linalg.norm(true)
                ),
                coverage_percent=float(100 * np.mean(inside)) if inside else np.nan,
                spread_over_interval=float(
                    np.median(2 * PER_INTERVAL * spread / np.median(high - low, axis=0))
                ),
                trusted=sum(fit.verdict == "trust" for fit in fits),
                false_trust=sum(false_trust(fit, true) for fit in fits),
            )
        )
    return rows


def false_trust(fit: RunFit, true: Array) -> bool:
    """Whether the verdict is wrongly `trust`: an essential parameter is far
    off, or M is not positive.
    """
    wrong = not fit.positive or bool((fit.half_widths_off(true)[fit.essential] > FALSE_TRUST).any())
    return fit.verdict == "trust" and wrong


def study_file(
    study: Study, runs: Sequence[Run], base: BaseParameters, true: Array
) -> dict[str, Any]:
    """The JSON file of a study: settings, names of the parameters, their true values
    (b,), summaries, every run.
    """
    return {
        "study": study,
        "parameters": base.names,
        "true": true,
        "summaries": summaries(runs, true),
        "runs": runs,
    }


def study_document(robot: str, study: Study, runs: Sequence[Run], true: Array) -> Document:
    """A study's summaries by method, its settings, and the runs with false trust."""
    rows = tuple(
        (method, *map(Number, numbers, FORMATS))
        for method, *numbers in map(astuple, summaries(runs, true))
    )
    fits = [
        (f"{method} in run {r.number}", getattr(r, kind)) for r in runs for method, kind in METHODS
    ]
    false = [name for name, fit in fits if fit and false_trust(fit, true)]
    lines = (
        f"{study.runs} runs of {study.duration_s:g} s at {study.sample_rate_hz:g} Hz, seed "
        f"{study.seed}; cell: "
        f"{study.noise.text}; of iv, converged runs only",
        f"false trust: verdict trust although an essential parameter is more than {FALSE_TRUST:g} "
        "half-widths off "
        f"or M is not positive: {', '.join(false) or 'no run'}",
    )
    return Document(
        title=f"{robot}: {len(runs)} runs",
        sections=(
            Section(
                table=Table(columns=columns("method", numbers=HEADINGS), rows=rows), lines=lines
            ),
        ),
    )


def border_line(robot: Robot) -> tuple[str, ...]:
    """What the study simulated without friction or rotor, which no real robot is;
    nothing if all have values.
    """
    model = InverseModel(robot)
    names = [
        name
        for name, skip in zip(
            model.names, model.of_links | (known_parameters(model) != 0), strict=True
        )
        if not skip and not name.startswith("Off")
    ]
    return (
        f"values at the border of the possible, 0 in [parameters] or absent: {', '.join(names)}",
    ) * bool(names)


def base_file(base: BaseParameters, robot: Robot, true: Array | None = None) -> dict[str, Any]:
    """The JSON file of base parameters, whose names end with a joint's number from 1, with the
    `true` values (b,) if known.
    """
    parameters = [
        dict(zip(("name", "expression", "unit"), row, strict=True))
        for row in zip(base.names, base.expressions, base.units, strict=True)
    ]
    for parameter, value in zip(parameters, () if true is None else true.tolist(), strict=False):
        parameter["value"] = value
    return {
        "robot": robot.name,
        "joint_names": [joint.name for joint in robot.joints],
        "parameters": parameters,
    }


def base_document(base: BaseParameters, robot: Robot) -> Document:
    """The base parameters of a robot as sums of standard parameters, in short the regrouped
    ones; its joints by number.
    """
    table = Table(
        columns=columns("name", "expression", "unit"),
        rows=tuple(zip(base.names, base.expressions, base.units, strict=True)),
    )
    joints = Table(
        columns=columns("number", "joint", "type"),
        rows=tuple((str(j + 1), joint.name, joint.type) for j, joint in enumerate(robot.joints)),
    )
    return Document(
        title=f"{robot.name}: {base.b} base parameters",
        sections=(
            Section(table=table).with_short_table(
                sorted(range(base.b), key=lambda k: base.expressions[k] == base.names[k]), 20
            ),
            Section(title="joints, by the number at the end of a name", table=joints),
        ),
    )
