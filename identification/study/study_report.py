"""Summaries and report of a study; documents of base parameters, and of estimates and true values."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from acquisition.robot import Robot

from ..arrays import Array
from ..methods import Fit
from ..model import BaseParameters, InverseModel, known_parameters
from ..report import Document, Number, ResultFile, Row, Section, Table, columns, value_form
from .study import Run, RunFit, Study

FALSE_ERROR = 5.0  # times the error of least squares at the default cut-off
FALSE_TRUST = 3.0  # half-widths: largest error of an essential parameter for `trust`
INSIDE = 2.0  # half-widths: largest error of an essential parameter in a clean fit
NORMAL_QUANTILE = 1.96  # half-width of 95 % of a normal distribution, in deviations
# By heading of a table: the field of a `Summary`, and its format.
ESTIMATES = {
    "runs": ("runs", "d"),
    "bias %": ("bias_percent", ".3f"),
    "spread %": ("spread_percent", ".3f"),
    "median error %": ("median_error_percent", ".3f"),
    "worst error %": ("worst_error_percent", ".3f"),
    "sigma / spread": ("sigma_over_spread", ".2f"),
    "converged %": ("converged_percent", ".1f"),
    "passes": ("mean_passes", ".1f"),
    "false %": ("false_percent", ".1f"),
}
VERDICTS = {
    "coverage %": ("coverage_percent", ".1f"),
    "half-width /\n1.96 spread": ("half_over_spread", ".2f"),
    "fits": ("verdicts", "d"),
    "trust": ("trusted", "d"),
    "false trust": ("false_trust", "d"),
    "clean": ("clean", "d"),
    "false caution": ("false_caution", "d"),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary:
    """Runs at one cut-off by one method: of wls those with an estimate, of iv those that converged. NaN if there are none.

    `bias_percent`, `spread_percent`: norms over all parameters in percent of the norm of the true ones.
    `sigma_over_spread`: median over the parameters of the formula's deviation over the observed one.
    `false_percent`: converged runs whose M is not positive, or whose error exceeds `FALSE_ERROR` times that of least squares at
    the default cut-off on the same recording (which may be very accurate by chance).

    `coverage_percent`: true values inside their 95 % intervals, over all parameters. `half_over_spread`: median over the
    parameters of half-width over 1.96 observed deviations. `false_trust`: runs with verdict `trust` although an essential
    parameter is more than `FALSE_TRUST` half-widths off or M is not positive. `clean`: runs whose fit knows everything except
    the noise, with M positive and every essential parameter within `INSIDE` half-widths; `false_caution`: clean runs in which
    a test has level `caution` or `do not use`.
    """

    method: str
    cutoff: float
    runs: int
    bias_percent: float
    spread_percent: float
    sigma_over_spread: float
    median_error_percent: float
    worst_error_percent: float
    converged_percent: float | None
    mean_passes: float | None
    false_percent: float | None
    coverage_percent: float
    half_over_spread: float
    verdicts: int
    trusted: int
    false_trust: int
    clean: int
    false_caution: int


def summaries(runs: Sequence[Run], true: Array) -> list[Summary]:
    """One summary per cut-off and method; `true` (b,) are the values simulated with."""
    rows = []
    for cutoff in sorted({r.drawn.cutoff for r in runs}, key=lambda c: c or np.inf):
        here = [r for r in runs if r.drawn.cutoff == cutoff]
        converged = [r for r in here if r.status == "converged"]
        false = [r for r in converged if r.iv and not (r.iv.positive and r.iv.error <= FALSE_ERROR * r.error_tuned_ls)]
        for method, kind in (("wls", "ls"), ("iv", "iv")):
            fits: list[tuple[Run, RunFit]] = [(r, fit) for r in here if (fit := getattr(r, kind)) is not None]
            used = [fit for r, fit in fits if method == "wls" or r.status == "converged"]
            beta, sigma, errors, half = (_stack(used, name, true) for name in ("beta", "sigma", "error", "half"))
            inside = [fit.half_widths_off(true) <= 1 for fit in used]
            spread = beta.std(axis=0, ddof=1) if len(used) > 1 else np.full(len(true), np.nan)
            rows.append(
                Summary(
                    method=method,
                    cutoff=cutoff,
                    runs=len(used),
                    bias_percent=float(100 * np.linalg.norm(beta.mean(axis=0) - true) / np.linalg.norm(true)),
                    spread_percent=float(100 * np.linalg.norm(spread) / np.linalg.norm(true)),
                    sigma_over_spread=float(np.median(np.median(sigma, axis=0) / spread)),
                    median_error_percent=float(100 * np.median(errors)),
                    worst_error_percent=float(100 * errors.max()),
                    converged_percent=100 * len(converged) / len(here) if method == "iv" else None,
                    mean_passes=float(np.mean([r.passes for r in converged])) if method == "iv" and converged else None,
                    false_percent=100 * len(false) / len(here) if method == "iv" else None,
                    coverage_percent=float(100 * np.mean(inside)) if inside else np.nan,
                    half_over_spread=float(np.median(np.median(half, axis=0) / (NORMAL_QUANTILE * spread))),
                    verdicts=len(fits),
                    trusted=sum(fit.verdict == "trust" for _, fit in fits),
                    false_trust=sum(false_trust(fit, true) for _, fit in fits),
                    clean=sum(is_clean(r, fit, true) for r, fit in fits),
                    false_caution=sum(is_clean(r, fit, true) and bool(fit.doubts) for r, fit in fits),
                )
            )
    return rows


def _stack(fits: Sequence[RunFit], name: str, true: Array) -> Array:
    """An attribute of all fits (fits, ...); a row of NaN without fits."""
    return np.array([getattr(fit, name) for fit in fits]) if fits else np.full((1, len(true)), np.nan)


def false_trust(fit: RunFit, true: Array) -> bool:
    """Whether the verdict is wrongly `trust`: an essential parameter is far off, or M is not positive."""
    wrong = not fit.positive or bool((fit.half_widths_off(true)[fit.essential] > FALSE_TRUST).any())
    return fit.verdict == "trust" and wrong


def is_clean(run: Run, fit: RunFit, true: Array) -> bool:
    """Whether the fit knows everything except the noise, and is right."""
    return run.drawn.modelled and fit.positive and bool((fit.half_widths_off(true)[fit.essential] <= INSIDE).all())


class BaseParameter(msgspec.Struct, frozen=True, kw_only=True):
    """A base parameter, its sum of standard parameters, and its value if known."""

    name: str
    expression: str
    unit: str
    value: float | UnsetType = UNSET


class BaseFile(ResultFile, frozen=True, kw_only=True):
    """The JSON file of a robot's base parameters, or of the values that a recording was simulated with."""

    robot: str
    joint_names: list[str]  # of joints 1, 2, ...: names of parameters end with this number
    parameters: list[BaseParameter]


class StudyFile(ResultFile, frozen=True, kw_only=True):
    """The JSON file of a study: settings, names of the parameters, truth, summaries, every run."""

    study: dict[str, Any]
    parameters: list[str]
    true: list[float]
    summaries: list[dict[str, Any]]
    runs: list[dict[str, Any]]


def base_file(base: BaseParameters, robot: Robot, true: Array | None = None) -> BaseFile:
    """The JSON file of base parameters; arguments as of `base_document`."""
    values: list[float | UnsetType] = [UNSET] * base.b if true is None else [float(x) for x in true]
    parameters = [
        BaseParameter(name=name, expression=expression, unit=unit, value=value)
        for name, expression, unit, value in zip(base.names, base.expressions, base.units, values, strict=True)
    ]
    return BaseFile(robot=robot.name, joint_names=[joint.name for joint in robot.joints], parameters=parameters)


def study_file(study: Study, runs: Sequence[Run], base: BaseParameters, true: Array) -> StudyFile:
    """The JSON file of a study; `true` (b,) are the values of `base`."""
    return StudyFile(
        study=_to_builtins(study),
        parameters=list(base.names),
        true=true.tolist(),
        summaries=_to_builtins(summaries(runs, true)),
        runs=[_run_json(run, base.b) for run in runs],
    )


def _to_builtins(value: Any) -> Any:
    return msgspec.to_builtins(value, enc_hook=lambda numbers: numbers.tolist())


def _run_json(run: Run, b: int) -> dict[str, Any]:
    """A run, with the estimates of each fit at the top level, null without a fit."""
    content: dict[str, Any] = _to_builtins(run)
    content |= {name: content["drawn"][name] for name in ("cutoff", "start", "gain_error")}
    content["positive"] = run.iv is not None and run.iv.positive
    for kind in ("ls", "iv"):
        fit = content[kind] or {}
        for name, missing in (("error", None), ("beta", [None] * b), ("sigma", [None] * b)):
            content[f"{name}_{kind}"] = fit.pop(name, missing)
    return content


def base_document(base: BaseParameters, robot: Robot, true: Array | None = None) -> Document:
    """The base parameters of a robot as sums of standard parameters, in short the regrouped ones; its joints by number."""
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
    sums_first = sorted(range(base.b), key=lambda k: base.expressions[k] == base.names[k])
    parameters = Section(table=table).with_short_table(sums_first, 20)
    sections = (parameters, Section(title="joints, by the number at the end of a name", table=joints))
    return Document(title=f"{robot.name}: {base.b} base parameters", sections=sections)


def truth_document(robot: str, fits: Sequence[Fit], true: Array) -> Document:
    """Estimates next to the true values of a simulated recording.

    Each has the half-width of its 95 % interval, and its error in half-widths.
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
    section = Section(title="compared with the simulated values", table=table, lines=tuple(lines))
    essential = np.isin(fits[-1].base.names, fits[-1].essential_names)
    largest = np.lexsort((-np.abs(true), ~essential)).tolist()
    return Document(
        title=f"{robot}: {len(true)} estimated parameters and their true values",
        sections=(section.with_short_table(largest),),
    )


def study_document(robot: str, study: Study, runs: Sequence[Run], true: Array) -> Document:
    """A study's summaries by cut-off and method, and its settings."""
    rows = summaries(runs, true)
    return Document(
        title=f"{robot}: {len(runs)} runs",
        sections=(
            Section(table=_summary_table(rows, ESTIMATES), lines=study_notes(study)),
            Section(
                title="intervals and verdicts", table=_summary_table(rows, VERDICTS), lines=trust_notes(runs, true)
            ),
        ),
    )


def _summary_table(summaries: Sequence[Summary], cells: dict[str, tuple[str, str]]) -> Table:
    """The table of the fields in `cells`, which are as `ESTIMATES`."""
    rows: list[Row] = []
    for s in summaries:
        numbers = [(getattr(s, name), form) for name, form in cells.values()]
        cutoff = f"{s.cutoff:g} x bandwidth" if s.cutoff else "none"
        rows.append((cutoff, s.method, *("" if x is None else Number(x, form) for x, form in numbers)))
    return Table(columns=columns("cut-off", "method", numbers=tuple(cells)), rows=tuple(rows))


def trust_notes(runs: Sequence[Run], true: Array) -> tuple[str, ...]:
    """What the columns about verdicts count, and the runs with false trust."""
    numbers_of = {
        method: [r.number for r in runs if (fit := getattr(r, kind)) is not None and false_trust(fit, true)]
        for method, kind in (("wls", "ls"), ("iv", "iv"))
    }
    listed = "; ".join(f"{method}: {', '.join(map(str, numbers))}" for method, numbers in numbers_of.items() if numbers)
    return (
        "coverage %: true values inside their 95 % intervals, over all parameters; of iv, converged runs only",
        f"false trust: verdict trust although an essential parameter is more than {FALSE_TRUST:g} half-widths off or M is "
        f"not positive: {f'runs {listed}' if listed else 'no run'}",
        "clean: the fit knows everything except the noise, and every essential parameter is within "
        f"{INSIDE:g} half-widths; false caution: clean runs in which a test says caution or do not use",
    )


def border_line(robot: Robot) -> tuple[str, ...]:
    """What the study simulated without friction or rotor, which no real robot is; nothing if all have values."""
    model = InverseModel(robot)
    zero = model.of_links | (known_parameters(model) != 0)
    names = [name for name, skip in zip(model.names, zero, strict=True) if not skip and not name.startswith("Off")]
    if not names:
        return ()
    return (f"values at the border of the possible, 0 in [parameters] or absent: {', '.join(names)}",)


def study_notes(study: Study) -> tuple[str, str]:
    """What the study simulated and varied, and what `false %` counts."""
    noise = study.noise

    def join(values: Sequence[float]) -> str:
        return ", ".join(f"{x:g}" if x else "none" for x in values)

    cell, recorded, controllers = noise.text, str(noise.recorded), ", ".join(study.controllers)
    if study.vary == "everything":
        cell = f"imperfections of all kinds, encoder step about {noise.encoder_step:g}"
        recorded, controllers = "either", "described, none"
    return (
        f"{study.runs} runs of {study.duration_s:g} s at {study.sample_rate_hz:g} Hz, seed {study.seed}; cell: {cell}; torque "
        f"recorded as {recorded}; drawn by each run: cut-off {join(study.cutoffs)} x bandwidth, "
        f"start {join(study.starts)} x true inertia, gains {join(study.gain_errors)} x true, controller {controllers}",
        "false %: converged runs whose inertia matrix is not positive, or whose error is more than "
        f"{FALSE_ERROR:g} times that of least squares at the default cut-off on the same recording",
    )
