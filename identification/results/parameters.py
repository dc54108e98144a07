"""Parameters of a fit, known values, a priori links, and requested drive gains.

The module also applies the parameters of a stored fit, with its settings, to another recording or
robot.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import ArrayLike

from acquisition.errors import COMMAND_LINE, Location
from acquisition.files import read_bytes
from acquisition.robot import LowSpeed, Robot, load_robot, robot_from_files

from ..arrays import Array
from ..data import Signals, check_one_robot, load_signals
from ..estimation import essential_names, one_thread
from ..model import (
    BaseParameters,
    InverseModel,
    add_payload,
    base_parameters,
    base_prior,
    direct_model_of_base,
)
from ..regression import Overrides, Problem, make_problem, with_common_band
from ..report import FitFile, Parameter, ParameterSet, TorqueResidual, base_name, recording_of
from .evidence import Evidence, FitOnRecording, errors_ahead, errors_on, validated


def fitted_parameters(fit: Evidence, *, by_ls: bool = False) -> ParameterSet:
    """Return the parameters that a fit estimated, labelled by its method: IV, LS or OLS.

    `by_ls`: those that least squares of the same recording estimated, labelled LS.
    """
    of = fit.least_squares if by_ls else fit
    e, intervals = of.estimate, of.intervals
    essential = essential_names(fit.essential, e, intervals)
    known = true_parameters(fit.base, np.zeros(fit.base.b)).parameters
    norms = zip(fit.data.estimate.names, np.linalg.norm(fit.data.W, axis=0).tolist(), strict=True)
    torque = {} if by_ls else dict(norms)
    columns = e.beta, intervals.low, intervals.high, e.sigma, e.sigma_percent
    return ParameterSet(
        label="LS" if by_ls else {"iv": "IV", "wls": "LS", "ols": "OLS"}[fit.method],
        parameters={
            name: msgspec.structs.replace(
                known[base_name(name)],
                name=name,
                value=value,
                low=low,
                high=high,
                sigma=sigma,
                sigma_percent=percent,
                essential=name in essential,
                prior=fit.data.prior.get(name, UNSET),
                column_norm=torque.get(name, UNSET),
            )
            for name, value, low, high, sigma, percent in zip(
                e.names, *(x.tolist() for x in columns), strict=True
            )
        },
    )


def urdf_prior(robot: Robot, urdf: str, name: str) -> Robot:
    """Return the robot with a URDF (its text) as the only source of link parameters.

    Joints are matched by name.
    """
    return replace(
        robot,
        name=name,
        joints=tuple(msgspec.structs.replace(joint, dh=None) for joint in robot.joints),
        urdf=urdf,
        parameters={},
    )


def read_prior(path: Path, robot: Robot) -> Robot:
    """Read the a priori links of the fitted `robot` from another robot.toml or URDF, by its name.

    Raises
    ------
    BadInputError : the file cannot be read, or describes another robot.
    """
    if path.suffix.lower() == ".toml":
        return replace(load_robot(path), name=path.name)
    return urdf_prior(robot, read_bytes(path).decode("utf-8", errors="replace"), path.name)


def prior_file(stored: FitFile, place: str, prior: Path) -> FitFile:
    """Return the a priori links of a robot.toml or URDF as known base parameters of a stored fit.

    Raises
    ------
    BadInputError : the fit is in A or V or without description; the file is of another robot, or
        gives no links.
    """
    refuse_unknown_gain(robot := stored_robot(stored, place))
    base = base_parameters(model := InverseModel(robot))
    values, _ = base_prior(model, base, InverseModel(read_prior(prior, robot)))
    Location(str(prior)).require(
        values,
        text="no link has all its inertial parameters",
        advice="Complete `inertial` of a URDF, or `[parameters]`",
    )
    known = true_parameters(
        base, np.array([values.get(name, 0.0) for name in base.names])
    ).parameters
    return FitFile(parameters=[known[name] for name in values])


def true_parameters(base: BaseParameters, true: Array) -> ParameterSet:
    """Return known values `true` (b,) of the base parameters, SI, labelled `true`.

    Their standard errors are 0.
    """
    return ParameterSet(
        label="true",
        parameters={
            name: Parameter(name=name, value=float(x), unit=unit, expression=expression)
            for name, x, unit, expression in zip(
                base.names, true, base.units, base.expressions, strict=True
            )
        },
    )


def stored_settings(
    stored: FitFile, signals: Signals, given: Overrides
) -> tuple[Overrides, list[str]]:
    """Return the settings of a stored fit for another recording, and warnings.

    Settings in `given` come first; known values have no settings. The delay of the fit is used if
    timing, effort objects and rate are equal, otherwise that known of the recording itself.
    """
    if stored.sample_rate_hz is None:
        return given, []
    rate_hz, low = signals.sample_rate_hz, stored.low_speed_percent
    n_d = stored.decimation and max(1, round(stored.decimation * rate_hz / stored.sample_rate_hz))
    lag_s: float | Literal["none"] | None = (
        "none" if stored.torque_lag_s is None else stored.torque_lag_s
    )
    notes = list[str]()
    if (lag := stored.lag) is not UNSET:
        compared = (
            ("effort object", signals.effort_object, lag.effort_object or lag.effort_provenance),
            ("effort timing", signals.effort_timing, lag.effort_timing),
            ("rate in Hz", rate_hz, stored.sample_rate_hz),
        )
        others = [
            f"its {name} is {own}, that of the fit {there}"
            for name, own, there in compared
            if own != there
        ]
        lag_s = None if others else lag.value_s
        if others and given.torque_lag_s is None:
            notes = [
                f"{signals.recording}: the lag of the fit, {1e3 * lag.value_s:.3g} ms, is not "
                f"used: {'; '.join(others)}; --torque-lag-s states one"
            ]
    return given.over(
        Overrides(
            cutoff_hz=stored.cutoff_hz or 0.0,
            decimation=n_d,
            span=stored.span_rule,
            edges=stored.edges,
            low_speed_percent=None if low is None else LowSpeed(ls=low.get("ls"), iv=low.get("iv")),
            torque_lag_s=lag_s,
        )
    ), notes


def refuse_unknown_gain(robot: Robot) -> None:
    """Refuse a fit in A or V.

    Its joints have unknown gains of their own, and a link's parameters would mix them.
    """
    for k, motor in enumerate(robot.motors):
        Location(f"robot {robot.name}").require(
            motor.gain is not None or robot.gain_known,
            f"motor[{k}].drive_gain",
            None,
            "a drive gain for every motor",
            text=f"the fit is in {motor.recorded_unit}; link parameters need N m",
        )


def stored_robot(stored: FitFile, place: str) -> Robot:
    """Return the robot of the description in a fit's file; refuse a file without one."""
    Location(place).require(stored.description, "description", None, "a fit with its robot.toml")
    files = {name: text.encode() for name, text in stored.description.items()}
    return with_stored_gains(stored, robot_from_files(files, place))


def with_stored_gains(stored: FitFile, robot: Robot) -> Robot:
    """Return the robot with the drive gains that a fit identified."""
    if stored.gains is UNSET:
        return robot
    found = {one.motor: one.value for one in stored.gains}
    gains = [found.get(m.name, gain) for m, gain in zip(robot.motors, robot.gain, strict=True)]
    return replace(robot, identified_gain=np.array(gains))


def stored_torque(stored: FitFile, place: str, *motion: ArrayLike) -> Array:
    """Return the torque IDM(q, dq, ddq) beta, (rows, n), of a stored fit.

    The `motion` consists of the three arrays q, dq, ddq (rows, n).
    """
    arrays = [np.asarray(x, dtype=np.float64) for x in motion]
    base = base_parameters(model := InverseModel(stored_robot(stored, place)))
    shapes = [x.shape for x in arrays]
    COMMAND_LINE.require(
        all(shape == (len(arrays[0]), model.robot.n) for shape in shapes),
        "shapes",
        shapes,
        f"(rows, {model.robot.n}) of q, dq and ddq",
    )
    return direct_model_of_base(model, base, stored_beta(stored, base, place)).torque(*arrays)


def other_meaning(stored: FitFile, base: BaseParameters) -> list[str]:
    """Return the parameters whose meaning differs in `base`.

    `base` lacks them, or has them in another unit or for another sum of standard parameters.
    """
    known = true_parameters(base, np.zeros(base.b)).parameters
    return [
        p.name
        for p in stored.parameters
        if (x := known.get(base_name(p.name))) is None
        or p.unit != x.unit
        or p.expression not in (None, x.expression)
    ]


def terms_without_fit(stored: FitFile, base: BaseParameters, place: str) -> list[str]:
    """Return a line on the parameters of `base` that count as zero.

    These are the ones that the fit neither has nor left out as not essential.
    """
    known = {base_name(p.name) for p in (*stored.parameters, *(stored.left_out or ()))}
    more = ", ".join(name for name in base.names if name not in known)
    return [f"{place} has no {more} of the description: zero, as in the fit"] if more else []


def consistent_fit(stored: FitFile, place: str) -> FitFile:
    """Return the fit with the values of its physically consistent set.

    A file without such a set is refused.
    """
    if not (given := {p.name: p.value for p in stored.standard_parameters or ()}):
        Location(place).refuse("standard_parameters", None, "`fit --consistent`")
    base = base_parameters(model := InverseModel(stored_robot(stored, place)))
    known = true_parameters(base, base.K @ [given.get(name, 0.0) for name in model.names])
    return msgspec.structs.replace(stored, parameters=list(known.parameters.values()))


def stored_beta(stored: FitFile, base: BaseParameters, place: str, sha256: str = "") -> Array:
    """Return the values (b,) of a stored fit in the order of `base`.

    They are zero if left out. A fit of another robot is refused. Per-recording parameters are those
    of the recording with the digest `sha256`; they are averaged if the fit does not have it.
    """
    values: dict[str, list[float]] = {}
    for p in stored.parameters:
        values.setdefault(base_name(p.name), []).append(p.value)
    foreign = [name for name in values if name not in base.names]
    Location(place).require(
        values and not foreign,
        "parameters",
        ", ".join(foreign[:5]) or None,
        f"those of the recording's robot: {', '.join(base.names[:5])}, ...",
    )
    units = {base_name(p.name): p.unit for p in stored.parameters}
    for name, unit in zip(base.names, base.units, strict=True):
        Location(place).require(
            units.get(name, unit) == unit,
            f"{name}.unit",
            units.get(name, unit),
            f"{unit}, as the recording's robot has it",
        )
    # Recordings of one name are numbered in the order of their digests.
    of_recording = {
        f"{Path(one.recording).stem}{number}"
        for k, one in enumerate(sorted(stored.recordings or (), key=lambda one: one.sha256), 1)
        if one.sha256 == sha256
        for number in ("", f"#{k}")
    }
    values |= {
        base_name(p.name): [p.value]
        for p in stored.parameters
        if recording_of(p.name) in of_recording
    }
    return np.array([np.mean(values.get(name, 0.0)) for name in base.names])


def payload_beta(stored: FitFile, problem: Problem) -> Array:
    """Return the base parameters (b,) of a recording's payload.

    They are those that the fit estimated if it has the same payload; otherwise those of a ball.
    """
    payload, model, base = problem.signals.payload, problem.model, problem.base
    if payload is None:
        return np.zeros(base.b)
    of_payloads = {one.stated: one.base_parameters for one in stored.payloads or ()}
    if found := of_payloads.get(payload.text):
        return np.array([found.get(name, 0.0) for name in base.names])
    return np.asarray(base.K @ add_payload(model, np.zeros(model.p), payload))


def signals_as_fitted(
    signals: Signals, recording: Path, stored: FitFile, place: str, *, chosen: bool
) -> tuple[Signals, list[str]]:
    """Return the signals of a recording with the fit's description if the two differ, and warnings.

    `chosen`: the user gave the description. `place` names the fit in the warnings.
    """
    signals = signals.with_gains_of(with_stored_gains(stored, signals.robot))
    other = other_meaning(stored, base := base_parameters(InverseModel(signals.robot)))
    if not other:
        return signals, terms_without_fit(stored, base, place)
    names = ", ".join(other[:5]) + (", ..." if len(other) > 5 else "")
    if chosen or not stored.description:
        return signals, [
            f"{place}: {names}: perhaps not the same quantities as those of robot "
            f"{signals.robot.name} here"
        ]
    again = load_signals(recording, stored_robot(stored, place))
    return replace(again, payload=signals.payload), [
        f"{signals.recording}: its description does not have the parameters of the fit "
        f"({names}): that of {place} is used"
    ]


@one_thread
def validate_all(
    recordings: Sequence[tuple[Signals, Overrides]],
    stored: FitFile,
    place: str,
    *,
    ahead: bool = True,
) -> tuple[tuple[FitOnRecording, ...], tuple[TorqueResidual, ...]]:
    """Return the torque of a stored fit on recordings of one robot, and the errors of all together.

    Nothing is fitted. Each recording comes with what replaces its settings; the errors are those of
    `errors_on`. Payloads are those that the fit estimated; `place` names it in errors. `ahead`:
    predict the motion too.
    """
    check_one_robot([signals for signals, _ in recordings])
    problems = with_common_band([make_problem(*one) for one in recordings])
    each = tuple(
        replace(validated(one, beta), ahead=errors_ahead(one.for_errors, beta) if ahead else None)
        for one in problems
        for beta in [
            stored_beta(stored, one.base, place, one.signals.sha256) + payload_beta(stored, one)
        ]
    )
    return each, errors_on(each)


def predict_recordings(
    stored: FitFile,
    place: str,
    recordings: Sequence[tuple[Signals, Path]],
    overrides: Overrides,
    *,
    chosen: bool = False,
    ahead: bool = True,
) -> tuple[tuple[FitOnRecording, ...], tuple[TorqueResidual, ...], tuple[str, ...]]:
    """Return the torque of a stored fit on recordings read from their paths.

    `validate_all` computes it in the same way. Warnings of their settings, of differences from the
    fit, and of the fit itself are returned too. `overrides` replace the settings of the fit;
    `chosen`: the user gave the description.
    """
    each, notes = list[tuple[Signals, Overrides]](), list[str]()
    for source, path in recordings:
        signals, of_robot = signals_as_fitted(source, path, stored, place, chosen=chosen)
        settings, of_lag = stored_settings(stored, signals, overrides)
        each.append((signals, settings))
        notes += of_robot + of_lag
    found, errors = validate_all(each, stored, place, ahead=ahead)
    of_settings = dict.fromkeys(text for one in found for text in one.problem.settings.warnings)
    return found, errors, (*of_settings, *dict.fromkeys(notes), *stored.warnings_of(place))
