"""What is said of a fit in the terminal: tables and lines."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ..data import ON_GRID, Signals
from ..estimation import TorqueError
from ..methods import Fit, InstrumentEvidence
from ..model import BaseParameters
from ..regression import Settings, forward_backward_3db_hz
from ..study import FALSE_ERROR, Run, Study, summaries
from .fit_file import base_json


def base_table(base: BaseParameters, robot: str) -> Table:
    """The base parameters with their expressions."""
    table = Table("name", "expression", "unit", title=f"{robot}: {base.b} base parameters", title_justify="left")
    for entry in base_json(base):
        table.add_row(entry["name"], entry["expression"], entry["unit"])
    return table


def fit_tables(signals: Signals, fit: Fit) -> RenderableType:
    """A fit for the terminal: parameters, errors by joint, and what it rests on."""
    e, essential = fit.estimate, set(fit.essential.estimate.names)
    units = dict(zip(fit.base.names, fit.base.units, strict=True))
    table = Table(title=f"{signals.robot.name}: {fit.method.upper()}, {len(e.names)} parameters", title_justify="left")
    for column in ("parameter", "value", "sigma", "%sigma", "sigma HAC", "unit", "essential"):
        table.add_column(column, justify="left" if column in ("parameter", "unit", "essential") else "right")
    for name, value, sigma, percent, hac in zip(e.names, e.beta, e.sigma, e.sigma_percent, fit.sigma_hac, strict=True):
        d = _decimals(float(sigma))
        table.add_row(
            name,
            f"{value:.{d}f}",
            f"{sigma:.{d}f}",
            f"{percent:.2f}" if percent < 1000 else "> 1000",
            f"{hac:.{d}f}" if math.isfinite(hac) else "-",
            units[name],
            "yes" if name in essential else "",
        )
    reduction, b = fit.essential, len(fit.base.names)
    kept = f"essential{' (by least squares)' if fit.iv else ''}: {len(reduction.kept)} of {b} parameters"
    if math.isfinite(reduction.F):
        kept += (
            f"; without the others F = {reduction.F:.2f}, p = {reduction.p_value:.2g}; with the residual's correlation "
            f"counted F = {reduction.F_effective:.2f}, p = {reduction.p_effective:.2g}"
        )
    condition = (
        f"cond(W) {e.condition_number:.4f}, with columns of norm one {e.condition_number_scaled:.4f}; {rows_told(fit)}"
    )
    status = f"status: {fit.status}" + (f": {fit.iv.reason}" if fit.iv and fit.iv.reason else "")
    lines = [
        *plan_lines(signals, fit.settings, used="fitted"),
        condition,
        kept,
        *(iv_lines(fit.iv) if fit.iv else []),
        status,
    ]
    return Group(
        table,
        *(iv_tables(fit.iv) if fit.iv else []),
        errors_table(fit.errors, signals.robot.effort_units),
        *(Text(line) for line in lines),
        *_warnings(fit.warnings),
    )


def rows_told(fit: Fit) -> str:
    """How many rows counted, and which were left out."""
    whole = fit.errors[-1]
    percent = fit.settings.low_speed.iv if fit.iv else fit.settings.low_speed.ls
    slow = (
        "4 % of the peak speed, or 4 deviations of its noise" if percent is None else f"{percent:g} % of the peak speed"
    )
    told = f"{fit.estimate.rows} of {whole.moving_rows + whole.standing_rows} rows"
    return told if percent == 0 else f"{told}, those below {slow} left out"


def iv_tables(iv: InstrumentEvidence) -> list[Table]:
    """The passes of the instrumental variable method, and the direct model against the recording."""
    passes = Table(title=f"passes from start: {iv.start}", title_justify="left")
    for column in (
        "pass",
        "instruments",
        "|rho|",
        "largest change",
        "of",
        "tracking %",
        "gains from .. to",
        "cond ZᵀW",
    ):
        passes.add_column(column, justify="left" if column in ("instruments", "of") else "right")
    for number, p in enumerate(iv.passes, 1):
        passes.add_row(
            str(number),
            p.instruments,
            f"{p.residual_norm:.3f}",
            f"{p.change_sigma:.2g} sigma",
            p.changed,
            "-" if p.tracking_percent is None else f"{p.tracking_percent:.2f}",
            f"{p.gains.min():.3g} .. {p.gains.max():.3g}",
            f"{p.condition:.1f}",
        )
    direct = Table(title="simulated robot against the recording, %", title_justify="left")
    for column in ("joint", "position", "torque"):
        direct.add_column(column, justify="left" if column == "joint" else "right")
    for d in iv.direct:
        errors = (d.position_error_percent, d.torque_error_percent)
        direct.add_row(d.name, *("-" if x is None else f"{x:.2f}" for x in errors))
    return [passes, direct] if iv.direct else [passes]


def iv_lines(iv: InstrumentEvidence) -> list[str]:
    """Tests of the instruments, in words; why a pass went without simulation."""
    t = iv.tests
    lines = [f"pass {k}: instruments {p.instruments}: {p.reason}" for k, p in enumerate(iv.passes, 1) if p.reason]
    if t.dwh_F is None or t.dwh_F_effective is None or t.dwh_p_value is None or t.dwh_p_effective is None:
        dwh = "instruments and regressor agree: nothing to test"
    else:
        dwh = (
            f"Durbin-Wu-Hausman F = {t.dwh_F:.2f}, p = {t.dwh_p_value:.2g}; with the residual's correlation counted "
            f"F = {t.dwh_F_effective:.2f}, p = {t.dwh_p_effective:.2g}"
        )
    strength = f"instruments: smallest correlation with W {t.strength:.3f}, first-stage F {t.first_stage_F:.3g}"
    used = f"{iv.rows_used_percent:.1f} % of the rows used; reference {iv.reference}, controller {iv.controller}"
    return [*lines, dwh, strength, used]


def study_table(robot: str, runs: Sequence[Run], true: NDArray[np.float64]) -> Table:
    """A study's summaries: one row per cut-off and method."""
    table = Table(title=f"{robot}: {len(runs)} runs", title_justify="left")
    columns = ("cut-off", "method", "runs", "bias %", "spread %", "median error %", "worst error %", "sigma / spread")
    for column in (*columns, "HAC / spread", "within 3 sigma %", "converged %", "passes", "false %"):
        table.add_column(column, justify="left" if column in ("cut-off", "method") else "right")
    for s in summaries(runs, true):
        numbers = (s.bias_percent, s.spread_percent, s.median_error_percent, s.worst_error_percent)
        table.add_row(
            f"{s.cutoff:g} x bandwidth" if s.cutoff else "none",
            s.method,
            str(s.runs),
            *(f"{x:.3f}" if np.isfinite(x) else "-" for x in numbers),
            *(f"{x:.2f}" if np.isfinite(x) else "-" for x in (s.sigma_over_spread, s.hac_over_spread)),
            f"{s.within_percent:.1f}" if np.isfinite(s.within_percent) else "-",
            *("" if x is None else f"{x:.1f}" for x in (s.converged_percent, s.mean_passes, s.false_percent)),
        )
    return table


def study_notes(study: Study) -> list[str]:
    """Under a study's table: what was simulated and varied, and what `false %` counts."""
    noise = study.noise

    def listed(values: Sequence[float]) -> str:
        return ", ".join(f"{x:g}" if x else "none" for x in values)

    return [
        f"{study.runs} runs of {study.duration_s:g} s at {study.sample_rate_hz:g} Hz, seed {study.seed}; noise: encoder step "
        f"{noise.encoder_step:g}, position {noise.position:g} (rad or m), effort {noise.effort_percent:g} % of its rms; "
        f"drawn by each run: cut-off {listed(study.cutoffs)} x bandwidth, start {listed(study.starts)} x true inertia, gains "
        f"{listed(study.gain_errors)} x true",
        "false %: runs called converged that should not be: their inertia matrix is not positive, or they are off by more than "
        f"{FALSE_ERROR:g} times what least squares at the rule's cut-off is on the same recording",
    ]


def truth_table(fits: Sequence[Fit], true: NDArray[np.float64]) -> RenderableType:
    """Estimates beside the values (b,) that a recording was simulated with; off by how many deviations, HAC or formula."""
    table = Table(title="against the values simulated with", title_justify="left")
    table.add_column("parameter")
    table.add_column("true", justify="right")
    for fit in fits:
        for column in (fit.method, "sigma", "off by,\nsigma"):
            table.add_column(column, justify="right")
    for i, name in enumerate(fits[0].base.names):
        d = _decimals(min(_deviation(fit)[i] for fit in fits))
        cells = []
        for fit in fits:
            sigma = _deviation(fit)[i]
            off = f"{(fit.beta[i] - true[i]) / sigma:+.1f}" if sigma > 0 else "-"
            cells += [f"{fit.beta[i]:.{d}f}", f"{sigma:.{d}f}", off]
        table.add_row(name, f"{true[i]:.{d}f}", *cells)
    lines = []
    for fit in fits:
        off_by = np.abs(fit.beta - true) / _deviation(fit)
        error = 100 * np.linalg.norm(fit.beta - true) / np.linalg.norm(true)
        lines.append(
            f"{fit.method}: {(off_by < 3).sum()} of {len(true)} within 3 sigma; |beta - true| = {error:.2f} % of |true|"
        )
    return Group(table, *(Text(line) for line in lines))


def _deviation(fit: Fit) -> NDArray[np.float64]:
    """The larger of both deviations (b,) of a fit of all parameters."""
    return np.fmax(fit.sigma_hac, fit.estimate.sigma)


def errors_table(errors: tuple[TorqueError, ...], units: tuple[str, ...]) -> Table:
    """Relative torque errors by joint: whole, moving, standing."""
    table = Table(title="relative torque error, %", title_justify="left")
    for column in ("joint", "unit", "all rows", "moving", "standing", "rows moving", "rows standing", "residual lag-1"):
        table.add_column(column, justify="left" if column in ("joint", "unit") else "right")
    for error, unit in zip(errors, (*units, ""), strict=True):
        if error.name == "all":
            table.add_section()
        table.add_row(
            error.name,
            unit,
            *(
                "-" if x is None else f"{x:.4f}"
                for x in (
                    error.relative_error_percent,
                    error.moving_relative_error_percent,
                    error.standing_relative_error_percent,
                )
            ),
            str(error.moving_rows),
            str(error.standing_rows),
            "-" if error.autocorrelation is None else f"{error.autocorrelation:.2f}",
        )
    return table


def plan_lines(signals: Signals, plan: Settings, *, used: str = "judged on") -> list[str]:
    """The settings in words; `used` says what is done with the span."""
    fs = signals.sample_rate_hz
    if plan.cutoff_hz is None:
        cutoff = "no low-pass"
    else:
        both = forward_backward_3db_hz(plan.cutoff_hz, fs)
        cutoff = f"low-pass {plan.cutoff_hz:g} Hz (-3 dB one way; forward and backward -3 dB at {both:.1f} Hz)"
    timing = (
        f"; samples up to {signals.off_grid:.2g} periods off a uniform grid: interpolated"
        if signals.off_grid > ON_GRID
        else ""
    )
    return [
        f"{signals.recording}: {fs:g} Hz, {cutoff}, decimated by {plan.decimation}"
        + (" with MATLAB's edge rule" if plan.edges == "matlab" else "")
        + timing,
        f"{used}: {plan.span}, {plan.start / fs:.3f} s to {plan.stop / fs:.3f} s of {len(signals.q) / fs:.3f} s",
    ]


def _warnings(warnings: Iterable[str]) -> list[Text]:
    return [Text(f"warning: {text}", style="yellow") for text in warnings]


def _decimals(sigma: float) -> int:
    """Four decimals, or more where sigma would not show three digits."""
    return max(4, min(12, 2 - math.floor(math.log10(sigma)))) if sigma > 0 else 4
