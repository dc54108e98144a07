"""What is said of a fit: the terminal's tables, the JSON file, and the reading of that file."""

import json
import math
import platform
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from acquisition.whole_file import whole_file

from . import IdentificationError
from .base_parameters import BaseParameters
from .diagnostics import TorqueError
from .filtering import forward_backward_3db_hz
from .fit import Fit, InstrumentEvidence
from .plan import Plan
from .signals import Signals
from .study import Run, summaries

FORMAT = 1


class StoredParameter(msgspec.Struct, frozen=True):
    """A parameter as a fit's JSON file has it; other keys are not read back."""

    name: str
    value: float
    sigma: float
    unit: str


class StoredFit(msgspec.Struct, frozen=True):
    """A fit's JSON file, as far as it is read back."""

    format: int
    method: str
    status: str
    parameters: list[StoredParameter]

    def beta(self, base: BaseParameters, place: str) -> NDArray[np.float64]:
        """(b,) values in the order of `base`, zero for those the fit left out; refuses a fit of another robot."""
        values = {p.name: p.value for p in self.parameters}
        foreign = [name for name in values if name not in base.names]
        if foreign or not values:
            raise IdentificationError(
                f"{place}: parameters {', '.join(foreign[:5]) or '(none)'}: expected those of the recording's robot: "
                f"{', '.join(base.names[:5])}, ..."
            )
        units = {p.name: p.unit for p in self.parameters}
        for name, unit in zip(base.names, base.units, strict=True):
            if units.get(name, unit) != unit:
                raise IdentificationError(f"{place}: {name} in {units[name]}; the recording's robot has it in {unit}")
        return np.array([values.get(name, 0.0) for name in base.names])


def read_fit(path: Path) -> StoredFit:
    """Read a fit's JSON file; an error is one line that names the file, the key and what was expected."""
    try:
        stored = msgspec.json.decode(path.read_bytes(), type=StoredFit)
    except OSError as error:
        raise IdentificationError(f"{path}: cannot be read: {error.strerror}") from error
    except msgspec.MsgspecError as error:
        raise IdentificationError(f"{path}: not a fit as `robot-identify fit --json` writes it: {error}") from error
    if stored.format != FORMAT:
        raise IdentificationError(f"{path}: format = {stored.format}; this version reads {FORMAT}")
    if not all(math.isfinite(p.value) and p.sigma >= 0 for p in stored.parameters):
        raise IdentificationError(f"{path}: parameters: expected finite values and sigmas of at least 0")
    return stored


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file whole or not at all."""
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def base_json(base: BaseParameters) -> list[dict[str, str]]:
    """The base parameters of a robot: name, expression, unit."""
    return [
        {"name": name, "expression": expression, "unit": unit}
        for name, expression, unit in zip(base.names, base.expressions, base.units, strict=True)
    ]


def fit_json(signals: Signals, fit: Fit) -> dict[str, Any]:
    """A fit as it goes into its JSON file; a number that does not exist (no standing rows, say) is null."""
    e, essential = fit.estimate, set(fit.essential.estimate.names)
    known = {entry["name"]: entry for entry in base_json(fit.base)}
    return {
        "format": FORMAT,
        "method": fit.method,
        "status": fit.status,
        "warnings": list(fit.warnings),
        **errors_json(fit.errors, signals.robot.effort_units),
        "condition_number": e.condition_number,
        "condition_number_scaled": e.condition_number_scaled,
        **plan_json(signals, fit.plan),
        "rows": e.rows,
        **(iv_json(fit.iv) if fit.iv else {}),
        "parameters": [
            {
                **known[name],
                "value": float(value),
                "sigma": float(sigma),
                "sigma_percent": _number(percent),
                "sigma_hac": _number(hac),
                "essential": name in essential,
            }
            for name, value, sigma, percent, hac in zip(
                e.names, e.beta, e.sigma, e.sigma_percent, fit.sigma_hac, strict=True
            )
        ],
        "essential": {
            "names": list(fit.essential.estimate.names),
            "F": _number(fit.essential.F),
            "p_value": _number(fit.essential.p_value),
            "F_effective": _number(fit.essential.F_effective),
            "p_effective": _number(fit.essential.p_effective),
        },
        "provenance": provenance(signals),
    }


def iv_json(iv: InstrumentEvidence) -> dict[str, Any]:
    """What the instrumental variable method adds: why it ended, pass by pass, tests of the instruments, direct model."""
    return {
        "reason": iv.reason,
        "start": iv.start,
        "reference": iv.reference,
        "controller": iv.controller,
        "iterations": [
            {
                "instruments": p.instruments,
                "reason": p.reason,
                "residual_norm": p.residual_norm,
                "largest_change_sigma": _number(p.change_sigma),
                "largest_change_percent": _number(p.change_percent),
                "changed_most": p.changed,
                "gains": [float(g) for g in p.gains],
                "tracking_error_percent": p.tracking_percent,
                "condition_number_ztw": _number(p.condition),
                "settled": p.settled,
            }
            for p in iv.passes
        ],
        "instrument_tests": {name: None if x is None else _number(x) for name, x in vars(iv.tests).items()},
        "rows_used_percent": iv.rows_used_percent,
        "saturated_percent": iv.saturated_percent,
        "direct_model": [vars(d) for d in iv.direct],
    }


def errors_json(errors: tuple[TorqueError, ...], units: tuple[str, ...]) -> dict[str, Any]:
    """Relative errors: of all joints together, and `joints` one by one."""
    whole = errors[-1]
    return {
        "relative_error_percent": whole.relative_error_percent,
        "moving_relative_error_percent": whole.moving_relative_error_percent,
        "standing_relative_error_percent": whole.standing_relative_error_percent,
        "joints": [{**vars(error), "unit": unit} for error, unit in zip(errors[:-1], units, strict=True)],
    }


def plan_json(signals: Signals, plan: Plan) -> dict[str, Any]:
    """The settings a fit was made with."""
    both = forward_backward_3db_hz(plan.cutoff_hz, signals.sample_rate_hz) if plan.cutoff_hz else None
    return {
        "sample_rate_hz": signals.sample_rate_hz,
        "cutoff_hz": plan.cutoff_hz,
        "cutoff_forward_backward_3db_hz": both,
        "decimation": plan.decimation,
        "span": plan.span,
        "samples": [plan.start, plan.stop],
    }


def provenance(signals: Signals) -> dict[str, Any]:
    """Where a result comes from: the recording by name and digest, the robot, the versions."""
    packages = ("robot-idim", "numpy", "scipy", "pin")
    return {
        "recording": signals.recording,
        "sha256": signals.sha256,
        "robot": signals.robot.name,
        "versions": {"python": platform.python_version(), **{name: version(name) for name in packages}},
    }


def _number(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


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
    kept = f"essential: {len(reduction.kept)} of {b} parameters"
    if math.isfinite(reduction.F):
        kept += (
            f"; without the others F = {reduction.F:.2f}, p = {reduction.p_value:.2g}; with the residual's correlation "
            f"counted F = {reduction.F_effective:.2f}, p = {reduction.p_effective:.2g}"
        )
    condition = (
        f"cond(W) {e.condition_number:.4f}, with columns of norm one {e.condition_number_scaled:.4f}; {e.rows} rows"
    )
    status = f"status: {fit.status}" + (f": {fit.iv.reason}" if fit.iv and fit.iv.reason else "")
    lines = [*plan_lines(signals, fit.plan), condition, kept, *(iv_lines(fit.iv) if fit.iv else []), status]
    return Group(
        table,
        *(iv_tables(fit.iv) if fit.iv else []),
        errors_table(fit.errors, signals.robot.effort_units),
        *(Text(line) for line in lines),
        *_warnings(fit.warnings),
    )


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
    lines = [f"pass {k}: instruments along the reference: {p.reason}" for k, p in enumerate(iv.passes, 1) if p.reason]
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
    columns = ("cut-off", "method", "runs", "bias %", "spread %", "median error %", "worst error %", "sigma/spread")
    for column in (*columns, "HAC/spread", "converged %", "passes", "false %"):
        table.add_column(column, justify="left" if column in ("cut-off", "method") else "right")
    for s in summaries(runs, true):
        numbers = (s.bias_percent, s.spread_percent, s.median_error_percent, s.worst_error_percent)
        table.add_row(
            f"{s.cutoff:g} x bandwidth" if s.cutoff else "none",
            s.method,
            str(s.runs),
            *(f"{x:.3f}" for x in numbers),
            f"{s.sigma_over_spread:.2f}",
            f"{s.hac_over_spread:.2f}",
            *("" if x is None else f"{x:.1f}" for x in (s.converged_percent, s.mean_passes, s.false_percent)),
        )
    return table


def truth_table(fit: Fit, values: NDArray[np.float64]) -> Table:
    """Estimates beside the values (b,) that a recording was simulated with."""
    table = Table(title="against the values simulated with", title_justify="left")
    for column in ("parameter", "true", "estimate", "sigma HAC", "error / sigma HAC"):
        table.add_column(column, justify="left" if column == "parameter" else "right")
    true = dict(zip(fit.base.names, values, strict=True))
    for name, value, sigma in zip(fit.estimate.names, fit.estimate.beta, fit.sigma_hac, strict=True):
        d = _decimals(float(sigma))
        off = f"{(value - true[name]) / sigma:+.2f}" if sigma > 0 else "-"
        table.add_row(name, f"{true[name]:.{d}f}", f"{value:.{d}f}", f"{sigma:.{d}f}", off)
    return table


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


def plan_lines(signals: Signals, plan: Plan) -> list[str]:
    """The settings in words."""
    fs = signals.sample_rate_hz
    if plan.cutoff_hz is None:
        cutoff = "no low-pass"
    else:
        both = forward_backward_3db_hz(plan.cutoff_hz, fs)
        cutoff = f"low-pass {plan.cutoff_hz:g} Hz (-3 dB one way; forward and backward -3 dB at {both:.1f} Hz)"
    return [
        f"{signals.recording}: {fs:g} Hz, {cutoff}, decimated by {plan.decimation}",
        f"fitted: {plan.span}, {plan.start / fs:.3f} s to {plan.stop / fs:.3f} s of {len(signals.q) / fs:.3f} s",
    ]


def _warnings(warnings: Iterable[str]) -> list[Text]:
    return [Text(f"warning: {text}", style="yellow") for text in warnings]


def _decimals(sigma: float) -> int:
    """Four decimals, or more where sigma would not show three digits."""
    return max(4, min(12, 2 - math.floor(math.log10(sigma)))) if sigma > 0 else 4
