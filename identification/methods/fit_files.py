"""The JSON files of a fit and of a validation, typed: `fit_schema` describes them to other programs."""

import math
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Annotated, Any

import msgspec
from msgspec import UNSET, UnsetType

from acquisition.robot import Edges, LowSpeed

from ..data import Signals
from ..estimation import TorqueError
from ..regression import Span, forward_backward_3db_hz
from ..report import Document, ResultFile, document_json
from ..simulation import DirectModelError, InstrumentKind
from ..trust import Assumed, Level, Verdict
from .comparison import Parameter, fitted_parameters
from .fit import Fit, InstrumentEvidence, Method, OwnTest, Status
from .recording_report import Validated
from .stored_fit import (
    ConsistentFile,
    Covariance,
    Doubt,
    LagFile,
    LeftOut,
    RecordingOfFit,
    StandardParameter,
    consistent_keys,
    recording_of_fit,
)


@dataclass(frozen=True, kw_only=True)
class JointError(TorqueError):
    """The torque errors of a joint in percent, with the unit of its torque; null where there are no such rows."""

    unit: str


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """Where a result comes from: the recording by name and digest, the robot, the versions."""

    recording: str
    sha256: str
    robot: str
    versions: dict[str, str]


class OnRecording(ResultFile, frozen=True, kw_only=True):
    """What a fit and a validation have in common: torque errors, of all joints and one by one, settings, warnings."""

    warnings: list[str]
    relative_error_percent: float | None
    moving_relative_error_percent: float | None
    standing_relative_error_percent: float | None
    joints: list[JointError]
    sample_rate_hz: Annotated[float, msgspec.Meta(gt=0)]
    off_grid_periods: float
    cutoff_hz: Annotated[float, msgspec.Meta(gt=0)] | None
    cutoff_forward_backward_3db_hz: float | None
    decimation: Annotated[int, msgspec.Meta(ge=1)]
    edges: Edges
    low_speed_percent: LowSpeed
    torque_lag_s: float | None = None
    span: str
    span_rule: Span
    samples: tuple[int, int]
    provenance: Provenance
    recordings: list[RecordingOfFit] | UnsetType = UNSET


class ValidationFile(OnRecording, frozen=True, kw_only=True):
    """The JSON file of `validate`: errors of a fit, by its file's name, and of its consistent set, that of all joints last."""

    fit: str
    consistent_errors: list[TorqueError] | UnsetType = UNSET


class EssentialSet(msgspec.Struct, frozen=True, kw_only=True):
    """The parameters that the recording determines well, and the F tests of leaving out the others."""

    names: list[str]
    F: float | None
    p_value: float | None
    F_effective: float | None
    p_effective: float | None


class FittedParameter(Parameter, frozen=True, kw_only=True):
    """A parameter as `fit` writes it."""

    sigma_percent: float | None


class TrustLineFile(msgspec.Struct, frozen=True, kw_only=True):
    """A test of the fit."""

    test: str
    level: Level
    value: float | None
    text: str


class PassFile(msgspec.Struct, frozen=True, kw_only=True):
    """A pass of the instrumental variable method."""

    instruments: InstrumentKind
    reason: str | None
    residual_norm: float
    largest_change_sigma: float | None
    largest_change_percent: float | None
    changed_most: str
    gains: list[float | None]
    tracking_error_percent: float | None
    condition_number_ztw: float | None
    settled: bool


class FitFile(OnRecording, frozen=True, kw_only=True):
    """The JSON file of a fit; earlier ones have no verdict and no covariance.

    `left_out` are the base parameters that `--essential` leaves out; `consistent` and `standard_parameters` are those of
    `--consistent`. The keys from `reason` on are those of instrumental variables.
    """

    method: Method
    status: Status
    doubts: list[Doubt]
    condition_number: float
    condition_number_scaled: float
    rows: int
    parameters: list[FittedParameter]
    essential: EssentialSet
    description: dict[str, str]
    covariance: Covariance | UnsetType = UNSET
    left_out: list[LeftOut] | UnsetType = UNSET
    consistent: ConsistentFile | UnsetType = UNSET
    standard_parameters: list[StandardParameter] | UnsetType = UNSET
    verdict: Verdict | UnsetType = UNSET
    method_reason: str | UnsetType = UNSET
    assumed: list[Assumed] | UnsetType = UNSET
    lag: LagFile | UnsetType = UNSET
    trust: list[TrustLineFile] | UnsetType = UNSET
    held_out_error_percent: float | UnsetType | None = UNSET
    own_parameters: OwnTest | UnsetType = UNSET
    reason: str | UnsetType | None = UNSET
    pass_returned: int | UnsetType = UNSET
    start: str | UnsetType = UNSET
    reference: str | UnsetType = UNSET
    controller: str | UnsetType = UNSET
    iterations: list[PassFile] | UnsetType = UNSET
    instrument_tests: dict[str, float | None] | UnsetType = UNSET
    contrast_half_widths: float | UnsetType | None = UNSET
    rows_used_percent: float | UnsetType = UNSET
    saturated_percent: float | UnsetType | None = UNSET
    direct_model: list[DirectModelError] | UnsetType = UNSET


def fit_schema() -> dict[str, Any]:
    """The JSON Schema of a fit's file."""
    return msgspec.json.schema(FitFile)


def fit_file(signals: Signals, fit: Fit, report: Document) -> FitFile:
    """A fit as it goes into its JSON file; a number that does not exist (no standing rows, say) is null."""
    e, reduction = fit.estimate, fit.essential
    return FitFile(
        **_on_recording(Validated(signals, fit.settings, fit.errors), fit.warnings, report),
        own_parameters=fit.own or UNSET,
        recordings=_several(
            [recording_of_fit(r.problem.signals, r.problem.settings, r.errors, r.held_out) for r in fit.recordings]
        ),
        method=fit.method,
        status=fit.status,
        doubts=[
            Doubt(text=line.text, severe=line.level == "do not use")
            for line in fit.trust.lines
            if line.test == "physical" and line.level != "ok"
        ],
        verdict=fit.trust.verdict,
        method_reason=fit.method_reason,
        assumed=list(fit.trust.assumed),
        lag=_lag(fit),
        held_out_error_percent=_finite(fit.trust.line("held-out blocks").value),
        trust=[
            TrustLineFile(test=line.test, level=line.level, value=_finite(line.value), text=line.text)
            for line in fit.trust.lines
        ],
        condition_number=e.condition_number,
        condition_number_scaled=e.condition_number_scaled,
        rows=e.rows,
        parameters=[
            FittedParameter(**msgspec.structs.asdict(parameter), sigma_percent=_finite(percent))
            for parameter, percent in zip(fitted_parameters(fit).parameters.values(), e.sigma_percent, strict=True)
        ],
        **consistent_keys(fit),
        essential=EssentialSet(
            names=list(fit.essential_names),
            F=_finite(reduction.F),
            p_value=_finite(reduction.p_value),
            F_effective=_finite(reduction.F_effective),
            p_effective=_finite(reduction.p_effective),
        ),
        description={
            name: signals.robot.files[name].decode("utf-8", errors="replace")
            for name in ("robot.toml", "robot.urdf")
            if name in signals.robot.files
        },
        **(_iv_keys(fit.iv) if fit.iv else {}),
    )


def _lag(fit: Fit) -> LagFile | UnsetType:
    """That of the first recording; others of several may have their own."""
    signals = fit.problem.signals
    for lag in fit.lags:
        if signals.recording in lag.recordings:
            return LagFile(
                value_s=lag.value_s,
                half_width_s=lag.half_width_s,
                source=lag.source,
                prior=lag.prior,
                effort_timing=signals.effort_timing,
                effort_provenance=signals.provenance,
            )
    return UNSET


def validation_file(
    recordings: Sequence[Validated],
    fit: str,
    errors: tuple[TorqueError, ...],
    report: Document,
    warnings: tuple[str, ...],
    consistent: tuple[TorqueError, ...] = (),
) -> ValidationFile:
    """A validation as it goes into its JSON file; arguments as `validation_document` has them, and that document."""
    first = replace(recordings[0], errors=errors)
    each = _several([recording_of_fit(one.signals, one.settings, one.errors) for one in recordings])
    of_set = list(consistent) or UNSET
    return ValidationFile(fit=fit, recordings=each, consistent_errors=of_set, **_on_recording(first, warnings, report))


def _several(recordings: list[RecordingOfFit]) -> list[RecordingOfFit] | UnsetType:
    return recordings if len(recordings) > 1 else UNSET


def _iv_keys(iv: InstrumentEvidence) -> dict[str, Any]:
    """What the instrumental variable method adds: why it ended, pass by pass, tests of the instruments, direct model."""
    return {
        "reason": iv.reason,
        "pass_returned": iv.returned,
        "start": iv.start,
        "reference": iv.reference,
        "controller": iv.controller,
        "iterations": [
            PassFile(
                instruments=p.instruments,
                reason=p.reason,
                residual_norm=p.residual_norm,
                largest_change_sigma=_finite(p.change_sigma),
                largest_change_percent=_finite(p.change_percent),
                changed_most=p.changed,
                gains=[_finite(g) for g in p.gains],
                tracking_error_percent=p.tracking_percent,
                condition_number_ztw=_finite(p.condition),
                settled=p.settled,
            )
            for p in iv.passes
        ],
        "instrument_tests": {name: _finite(x) for name, x in vars(iv.tests).items()},
        "contrast_half_widths": _finite(iv.contrast),
        "rows_used_percent": iv.rows_used_percent,
        "saturated_percent": iv.saturated_percent,
        "direct_model": list(iv.direct),
    }


def _on_recording(first: Validated, warnings: tuple[str, ...], report: Document) -> dict[str, Any]:
    signals, settings, errors = first.signals, first.settings, first.errors
    whole, units = errors[-1], signals.robot.effort_units
    packages = ("robot-idim", "numpy", "scipy", "pin")
    return {
        "report": document_json(report),
        "warnings": list(warnings),
        "relative_error_percent": whole.relative_error_percent,
        "moving_relative_error_percent": whole.moving_relative_error_percent,
        "standing_relative_error_percent": whole.standing_relative_error_percent,
        "joints": [JointError(**vars(error), unit=unit) for error, unit in zip(errors[:-1], units, strict=True)],
        "sample_rate_hz": signals.sample_rate_hz,
        "off_grid_periods": signals.off_grid,
        "cutoff_hz": settings.cutoff_hz,
        "cutoff_forward_backward_3db_hz": (
            forward_backward_3db_hz(settings.cutoff_hz, signals.sample_rate_hz) if settings.cutoff_hz else None
        ),
        "decimation": settings.decimation,
        "edges": settings.edges,
        "low_speed_percent": settings.low_speed,
        "torque_lag_s": settings.torque_lag_s,
        "span": settings.span,
        "span_rule": settings.span_rule,
        "samples": (settings.start, settings.stop),
        "provenance": Provenance(
            recording=signals.recording,
            sha256=signals.sha256,
            robot=signals.robot.name,
            versions={"python": platform.python_version(), **{name: version(name) for name in packages}},
        ),
    }


def _finite(x: float | None) -> float | None:
    return None if x is None or not math.isfinite(x) else float(x)
