"""A fit's JSON file: written whole or not at all, and read back."""

import json
import math
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from acquisition.files import atomic_write
from acquisition.robot import Edges, Robot, robot_from_files

from ..data import Signals
from ..errors import IdentificationError
from ..estimation import TorqueError
from ..methods import NO_FIXED_POINT, Doubt, Fit, InstrumentEvidence
from ..model import BaseParameters
from ..regression import Overrides, Settings, Span, forward_backward_3db_hz

FORMAT = 1


class StoredParameter(msgspec.Struct, frozen=True):
    """A parameter as a fit's JSON file has it, or that of known values, which have no sigma; other keys are not read back."""

    name: str
    value: float
    unit: str
    expression: str | None = None
    sigma: float = 0.0
    sigma_hac: float | None = None
    essential: bool = False


class StoredFit(msgspec.Struct, frozen=True):
    """The JSON file of a fit, or of known values, as far as it is read back."""

    parameters: list[StoredParameter]
    format: int = FORMAT
    method: str = "known"
    status: str = "known"
    doubts: list[Doubt] = msgspec.field(default_factory=list)
    description: dict[str, str] = msgspec.field(default_factory=dict)
    sample_rate_hz: Annotated[float, msgspec.Meta(gt=0)] | None = None
    cutoff_hz: Annotated[float, msgspec.Meta(gt=0)] | None = None
    decimation: Annotated[int, msgspec.Meta(ge=1)] | None = None
    span_rule: Span | None = None
    edges: Edges | None = None

    def settings(self, sample_rate_hz: float) -> Overrides:
        """The settings that the fit was made with, for a recording of that rate; known values have none."""
        if self.sample_rate_hz is None:
            return Overrides()
        n_d = self.decimation and max(1, round(self.decimation * sample_rate_hz / self.sample_rate_hz))
        return Overrides(cutoff_hz=self.cutoff_hz or 0.0, decimation=n_d, span=self.span_rule, edges=self.edges)

    def robot(self, place: str) -> Robot | None:
        """The robot as the fit's own description has it; None where the file holds none."""
        return (
            robot_from_files({k: v.encode() for k, v in self.description.items()}, place) if self.description else None
        )

    def other_meaning(self, base: BaseParameters) -> list[str]:
        """Parameters that `base` does not have, or has in another unit or for another sum of standard parameters."""
        known = {entry["name"]: entry for entry in base_json(base)}
        return [
            p.name
            for p in self.parameters
            if p.name not in known
            or p.unit != known[p.name]["unit"]
            or p.expression not in (None, known[p.name]["expression"])
        ]

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


def doubts(stored: StoredFit, place: str) -> list[str]:
    """What must be said wherever a fit is used that is not what it should be."""
    unsettled = stored.status in (*NO_FIXED_POINT, "not_confirmed")
    told = [f"its status is {stored.status}"] if unsettled else []
    return [f"{place}: {text}" for text in (*told, *(doubt.text for doubt in stored.doubts if doubt.severe))]


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
    if not all(math.isfinite(p.value) and p.sigma >= 0 and (p.sigma_hac or 0) >= 0 for p in stored.parameters):
        raise IdentificationError(f"{path}: parameters: expected finite values and sigmas of at least 0")
    return stored


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file whole or not at all."""
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    with atomic_write(path) as partial:
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
        "doubts": [vars(doubt) for doubt in fit.doubts],
        **errors_json(fit.errors, signals.robot.effort_units),
        "condition_number": e.condition_number,
        "condition_number_scaled": e.condition_number_scaled,
        **plan_json(signals, fit.settings),
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
        "description": {
            name: signals.robot.files[name].decode("utf-8", errors="replace")
            for name in ("robot.toml", "robot.urdf")
            if name in signals.robot.files
        },
    }


def iv_json(iv: InstrumentEvidence) -> dict[str, Any]:
    """What the instrumental variable method adds: why it ended, pass by pass, tests of the instruments, direct model."""
    return {
        "reason": iv.reason,
        "pass_returned": iv.returned,
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
                "gains": [_number(g) for g in p.gains],
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


def plan_json(signals: Signals, plan: Settings) -> dict[str, Any]:
    """The settings a fit was made with."""
    both = forward_backward_3db_hz(plan.cutoff_hz, signals.sample_rate_hz) if plan.cutoff_hz else None
    return {
        "sample_rate_hz": signals.sample_rate_hz,
        "off_grid_periods": signals.off_grid,
        "cutoff_hz": plan.cutoff_hz,
        "cutoff_forward_backward_3db_hz": both,
        "decimation": plan.decimation,
        "edges": plan.edges,
        "low_speed_percent": {"ls": plan.low_speed.ls, "iv": plan.low_speed.iv},
        "span": plan.span,
        "span_rule": plan.span_rule,
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


def truth_json(robot: str, base: BaseParameters, true: NDArray[np.float64]) -> dict[str, Any]:
    """The values (b,) that a recording was simulated with."""
    return {
        "robot": robot,
        "parameters": [{**entry, "value": float(x)} for entry, x in zip(base_json(base), true, strict=True)],
    }
