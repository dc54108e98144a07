"""Assesses a fit: torque errors, intervals, tests and warnings; with instruments also whether the passes converged."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..estimation import (
    Estimate,
    InstrumentTests,
    System,
    autocorrelation,
    f_tests,
    instrument_tests,
    intervals_of,
    torque_errors,
)
from ..regression import ROWS, Problem, base_name, sample_weights
from ..report import DirectModelError, FTest, Method, Status
from ..simulation import Replica, join_reasons, max_or_none
from ..trust import FitData, Lag, TrustLine, held_out_parts, trust_in
from .fit import Fit, FittedRecording, InstrumentEvidence, LeastSquares, Pass, essential_names
from .gains import add_scale_variance, results_of
from .observation import position_noise_line
from .recording_report import gain_warnings, recording_warnings
from .system import StackedSystem
from .timing import add_lag_variance

MAX_TRACKING_PERCENT = 20.0  # a larger error of the simulated position does not confirm the estimate
MAX_SATURATED_PERCENT = 1.0  # of the samples: above, a warning
MIN_FIRST_STAGE_F = 10.0


def evidence_of_ls(observed: StackedSystem, method: Method, ls: LeastSquares, lags: tuple[Lag, ...]) -> FitData:
    """Inputs of the trust tests of least squares, which has no instruments and cannot find the lags of the torques."""
    return FitData(
        recordings=observed.observations,
        observed=observed.regression,
        method=method,
        fixed_point=True,
        estimate=ls.estimate,
        predicted=ls.tau_predicted,
        intervals=ls.intervals,
        least_squares=ls.full,
        lags=lags,
        essential=essential_names(ls.essential, ls.estimate, ls.intervals),
    )


def position_noise_of(observed: StackedSystem, method: Method, ls: LeastSquares) -> TrustLine:
    """Bias of least squares by the position noise of the first recording, of its beginning if it is long."""
    first, alone = observed.problems()[0].with_samples(), observed.parameters.plain and not observed.load
    return position_noise_line(first, method, ls, alone=alone)


def fit_of(observed: StackedSystem, evidence: FitData, solved: LeastSquares, replicas: Sequence[Replica] = ()) -> Fit:
    """The fit of an estimate and its assessment; `replicas` are the robot simulated in each recording, if it was."""
    rows, predicted = observed.regression, solved.tau_predicted
    names = tuple(joint.name for joint in observed.problem.signals.robot.joints)
    evidence = replace(evidence, held_out=held_out_parts(evidence, observed.predicted))
    filtered, of_model = observed, predicted
    # errors of the model, without the noise that passes the cut-off of the fit
    if (behind := observed.behind_rule()) is not None:
        filtered, of_model = behind, behind.predicted(solved.estimate)
    measured = filtered.regression
    fitted = [
        FittedRecording(
            problem=one.problem,
            parameters=observed.parameters.of[k].settled(solved.estimate),
            rows=part,
            errors=torque_errors(measured.tau[own], of_model[own], measured.speed[own], names),
            held_out=evidence.held_out[k] if len(observed.observations) > 1 and not evidence.gains else None,
            replica=replicas[k] if replicas else None,
            states=one.states,
        )
        for k, (one, part, own) in enumerate(zip(observed.observations, observed.parts, filtered.parts, strict=True))
    ]
    fit = Fit(
        recordings=tuple(fitted[k] for k in observed.order),
        method=evidence.method,
        status="solved",
        estimate=solved.estimate,
        intervals=solved.intervals,
        least_squares=solved.of_base(),
        t_s=np.concatenate([one.t_s for one in observed.observations]),
        tau=rows.tau,
        tau_predicted=predicted,
        speed=rows.speed,
        errors=torque_errors(measured.tau, of_model, measured.speed, names),
        lags=evidence.lags,
        warnings=_warnings(observed),
        trust=trust_in(evidence),
        own=own_test(observed.with_motors(()), solved.full),
    )
    return fit if observed.parameters.plain else replace(fit, **results_of(observed, evidence))


def own_test(observed: StackedSystem, full: Estimate) -> FTest | None:
    """F test, by least squares, of the recordings' own parameters against shared ones; None if there are none."""
    parameters = observed.parameters
    if not parameters.any:
        return None
    observed = observed.at(full.values_of(parameters.names))  # after `with_motors` columns of load friction are zero
    rows = observed.regression
    W, Y = rows.system.weighted(full.weights)
    shared = list(dict.fromkeys(map(base_name, parameters.names)))
    merge = np.array([[float(base_name(name) == one) for one in shared] for name in parameters.names])
    scaled = [A / np.linalg.norm(A, axis=0) for A in (W, W @ merge)]
    norm, left = (float(np.linalg.norm(Y - A @ np.linalg.lstsq(A, Y)[0])) for A in scaled)
    rho = rows.residual(full.values_of(rows.system.names), full.weights)
    extra, freedom = len(parameters.names) - len(shared), full.rows - len(parameters.names)
    F = (left**2 - norm**2) / extra / (norm**2 / freedom) if norm > 0 else float("inf")
    F, p, F_effective, p_effective = f_tests(F, extra, full.rows, len(parameters.names), autocorrelation(rho) or 0.0)
    names = tuple(name for name in parameters.names if "@" in name)
    return FTest(names=names, F=F, p_value=p, F_effective=F_effective, p_effective=p_effective)


def _warnings(observed: StackedSystem) -> tuple[str, ...]:
    """Warnings of the settings and the recordings; several recordings may share one."""
    problems = [observed.observations[k].problem for k in observed.order]
    of_settings = [[*p.settings.warnings, *_short_moves(p), *gain_warnings(p.signals)] for p in problems]
    if len(problems) == 1:
        return (*of_settings[0], *recording_warnings(problems[0].signals))
    named = [f"{p.signals.recording}: {text}" for p in problems for text in recording_warnings(p.signals)]
    return (*dict.fromkeys(text for texts in of_settings for text in texts), *named)


def _short_moves(problem: Problem) -> list[str]:
    """Joints whose weights have shorter ramps than those of the settings, or none."""
    if not len(problem.signals.q):
        return []
    robot, asked = problem.signals.robot, problem.settings.ramp_rows
    return [
        f"joint {joint.name}: its moves are short for a bandwidth of {robot.bandwidth_hz:.3g} Hz: "
        + ("no weights, but rows in which it moves" if ramp == ROWS else f"ramps of {ramp:g} rows")
        for joint, ramp in zip(robot.joints, sample_weights(problem).ramps, strict=True)
        if ramp < asked or ramp == ROWS
    ]


def assess_iv(
    observed: StackedSystem,
    best: Pass,
    beginning: tuple[StackedSystem, Pass] | None,
    ls: LeastSquares,
    passes: Sequence[Pass],
    start: str,
) -> Fit:
    """The fit of the pass that is returned; the robot simulated with its estimate validates the direct model."""
    observed, estimate, replicas = observed.about(best.z), best.estimate, best.replicas
    evidence = _evidence_along(observed, best, ls)
    tests = _tests(evidence.observed.system, estimate)
    status, reason = _status(passes, best, [one.problem.signals.recording for one in observed.observations], tests)
    if reason is not None and best.number != len(passes):
        reason += f"; pass {best.number} is returned: it tracks best"
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.abs(ls.full.values_of(estimate.names) - estimate.beta) / evidence.intervals.half
        contrast = np.nan_to_num(np.where(np.isin(estimate.names, ls.full.names), off, 0.0))
    iv = InstrumentEvidence(
        start=start,
        reference="recorded" if all(one.reference_kind == "recorded" for one in replicas) else "surrogate",
        controller="described" if all(one.described for one in replicas) else "surrogate",
        passes=tuple(passes),
        returned=best.number,
        reason=reason,
        tests=tests,
        contrast=float(contrast.max()),
        contrast_at=estimate.names[int(contrast.argmax())],
        rows_used_percent=float(100 * observed.regression.counts.mean()),
        saturated_percent=_largest([max(one.saturated.values(), default=None) for one in replicas]),
        direct=_direct_errors(replicas),
    )
    evidence = replace(
        evidence,
        fixed_point=status in ("converged", "not_confirmed"),
        first_stage_F=tests.first_stage_F,
        unconfirmed=None if status == "converged" else f"status {status}: {reason}",
        beginning=None if beginning is None else _evidence_along(*beginning, ls),
    )
    own = replace(ls, estimate=estimate, intervals=evidence.intervals, tau_predicted=evidence.predicted)
    fit = fit_of(observed, evidence, own, replicas)
    warnings = (*fit.warnings, *_iv_warnings(replicas, tests))
    return replace(fit, status=status, iv=iv, least_squares=ls.of_base(), warnings=warnings)


def _evidence_along(observed: StackedSystem, best: Pass, ls: LeastSquares) -> FitData:
    """Inputs of the trust tests of an IV estimate."""
    observed, z, estimate = observed.about(best.z), best.z, best.estimate
    system = observed.along(z)
    within = add_lag_variance(estimate, intervals_of(system, estimate), observed.lags)
    within = add_scale_variance(observed, estimate, within)
    return FitData(
        recordings=observed.simulated(best.replicas),
        observed=replace(observed.regression, system=system),
        method="iv",
        fixed_point=True,
        estimate=estimate,
        predicted=observed.predicted(estimate),
        intervals=within,
        least_squares=ls.full,
        Z=z.Z,
        lags=observed.lags,
        essential=essential_names(ls.essential, estimate, within),
    )


def _tests(system: System, estimate: Estimate) -> InstrumentTests:
    """Tests of the instruments of an estimate."""
    indices = np.array([system.names.index(name) for name in estimate.names])
    W, _ = system.with_columns(indices).weighted(estimate.weights)
    return instrument_tests(estimate.Q, W, estimate.rows)


def _direct_errors(replicas: Sequence[Replica]) -> tuple[DirectModelError, ...]:
    """Largest errors of the simulated robot in any recording, by joint; none if one could not be simulated."""
    if any(not one.direct for one in replicas):
        return ()
    return tuple(
        DirectModelError(
            name=joint[0].name,
            position_error_percent=_largest([d.position_error_percent for d in joint]),
            torque_error_percent=_largest([d.torque_error_percent for d in joint]),
        )
        for joint in zip(*(one.direct for one in replicas), strict=True)
    )


def _largest(percents: list[float | None]) -> float | None:
    """The largest that is not None: a joint may stand in one recording, or have no torque."""
    return max((x for x in percents if x is not None), default=None)


def _status(
    passes: Sequence[Pass], best: Pass, recordings: Sequence[str], tests: InstrumentTests
) -> tuple[Status, str | None]:
    """`converged` needs settled passes, simulated instruments that explain W, and a simulation that tracks the recording.

    Other settled passes are `not_confirmed`. Every joint has to track: the mean over the robot would hide a joint of small
    travel.
    """
    last, unconfirmed = passes[-1], _unconfirmed(best.replicas, recordings)
    if last.failure is not None:
        return "diverged", last.failure
    if not tests.first_stage_F >= 1.0:
        return "diverged", f"the instruments do not explain the regressor: first-stage F = {tests.first_stage_F:.2g}"
    if last.settled:
        if unconfirmed is None and last.z.kind != "simulated":
            unconfirmed = f"settled without simulated instruments: {last.z.reason}"
        return ("converged", None) if unconfirmed is None else ("not_confirmed", unconfirmed)
    if unconfirmed is not None:
        return "diverged", unconfirmed
    moving = []
    if not last.parameters_settled:
        moving.append(f"{last.changed} still changes by {last.change_sigma:.2g} sigma")
    if not last.residual_settled:
        moving.append(f"the residual norm still changes by {last.residual_percent:.2g} %")
    return "max_iterations", f"after {len(passes)} passes " + " and ".join(moving)


def _unconfirmed(replicas: Sequence[Replica], recordings: Sequence[str]) -> str | None:
    """Why the simulation with the final estimate does not confirm it; None if it does."""
    reason = join_reasons([one.reason for one in replicas], recordings)
    if reason is not None:
        return f"the final estimate cannot be simulated: {reason}"
    tracking_percent = max_or_none([one.tracking_percent for one in replicas])
    if tracking_percent is None or not tracking_percent <= MAX_TRACKING_PERCENT:
        return "the simulated position does not follow the measured one"
    for d in _direct_errors(replicas):
        if d.position_error_percent is not None and not d.position_error_percent <= MAX_TRACKING_PERCENT:
            return f"simulated joint {d.name} differs by {d.position_error_percent:.1f} % from the measured one"
    return None


def _iv_warnings(replicas: tuple[Replica, ...], tests: InstrumentTests) -> tuple[str, ...]:
    warnings = []
    if any(one.reference_kind == "surrogate" for one in replicas):
        warnings.append(
            "surrogate reference: none recorded, the measured position is used instead; the instruments are not "
            "strictly exogenous"
        )
    if without := [one.bandwidth_hz for one in replicas if not one.described]:
        warnings.append(f"no controller described: simulated with a {without[0]:g} Hz PD instead")
    if unknown := [one.bandwidth_hz for one in replicas if one.described and not one.J_known]:
        warnings.append(
            "least squares gives no positive inertias: the gain update uses those that suit the described gains at "
            f"{unknown[0]:g} Hz"
        )
    for one in replicas:
        at_limit = (f"{name} in {x:.1f} %" for name, x in one.saturated.items() if x > MAX_SATURATED_PERCENT)
        if found := ", ".join(at_limit):
            warnings.append(f"drives at their limit: {found} of the samples")
    if tests.first_stage_F < MIN_FIRST_STAGE_F:
        warnings.append(f"weak instruments: first-stage F = {tests.first_stage_F:.2g}, below {MIN_FIRST_STAGE_F:g}")
    return tuple(warnings)
