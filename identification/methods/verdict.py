"""Assesses the instrumental variable method: each pass, the instruments, the direct model, and whether it converged."""

from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..estimation import Estimate, InstrumentTests, System, instrument_tests, lag_one
from ..simulation import DirectModelError, Instruments, Replica, told, worst
from ..trust import Evidence, Lag
from .assess import Verdict, assess_estimate, intervals_along, sums_along
from .fit import Fit, InstrumentEvidence, LeastSquares, Pass, Status, essential_names
from .iteration import IterationResult
from .timing import Along, Timed, counted

TRACKED_PERCENT = 20.0  # a simulation further off the measured position does not vouch for its estimate
SATURATED_PERCENT = 1.0  # a share of saturated samples worth a warning
WEAK_INSTRUMENTS_F = 10.0


def assess_iv(found: Timed, ls: LeastSquares, outcome: IterationResult) -> Fit:
    """A fit by instruments; the robot simulated with its estimate is the direct model's validation."""
    observed, estimate = found.whole.observed.about(outcome.z), outcome.estimate
    replicas, passes, long = outcome.final, outcome.passes, observed.regression.reduced
    evidence = _evidence_along(replace(found.whole, observed=observed), ls, found.lags)
    system, _ = observed.along(outcome.z)
    tests = _tests(system, estimate, observed.regression.tau - evidence.predicted, outcome.z.used)
    direct, names = _direct_errors(replicas), [part.problem.signals.recording for part in observed.evidence]
    final_reason = told([one.reason for one in replicas], names)
    tracking_percent = worst([one.tracking_percent for one in replicas])
    status, reason = _status(passes, final_reason, tracking_percent, outcome.failure, direct, tests)
    first = replicas[observed.order[0]]
    if reason is not None and outcome.returned != len(passes):
        reason += f"; pass {outcome.returned} is returned, which tracks best"
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.nan_to_num(np.abs(ls.full.among(estimate.names) - estimate.beta) / evidence.intervals.half)
    of_method = InstrumentEvidence(
        start=outcome.start,
        reference="recorded" if all(one.reference_kind == "recorded" for one in replicas) else "surrogate",
        controller="described" if all(one.described for one in replicas) else "surrogate",
        passes=passes,
        returned=outcome.returned,
        reason=reason,
        tests=tests,
        contrast=float(apart.max()),
        contrast_at=estimate.names[int(apart.argmax())],
        rows_used_percent=float(100 * outcome.z.used.mean()),
        saturated_percent=_largest([one.saturated_percent for one in replicas]),
        direct=direct,
        simulated=first.motion,
        q=first.q,
    )
    verdict = Verdict(status=status, iv=of_method, warnings=_iv_warnings(replicas, tests), replicas=replicas)
    evidence = replace(
        evidence,
        Z=None if long else evidence.Z,
        fixed_point=status in ("converged", "not_confirmed"),
        first_stage_F=tests.first_stage_F,
        unconfirmed=None if status == "converged" else f"status {status}: {reason}",
        factors=outcome.z.factors if len(outcome.z.factors) > 1 else (),
        blocks=sums_along(outcome.z, estimate),
        looked_at=None if found.beginning is None else _evidence_along(found.beginning, ls, found.lags),
    )
    return assess_estimate(observed, evidence, ls, evidence.predicted, verdict)


def _evidence_along(along: Along, ls: LeastSquares, lags: tuple[Lag, ...]) -> Evidence:
    """What an estimate by instruments rests on, in its rows."""
    observed, z, estimate = along.observed.about(along.z), along.z, along.estimate
    within = counted(estimate, intervals_along(observed, z, estimate), lags)
    return Evidence(
        parts=tuple(along.parts),
        observed=observed.regression,
        method="iv",
        fixed_point=True,
        estimate=estimate,
        predicted=observed.predicted(estimate),
        used=z.used,
        intervals=within,
        least_squares=ls.full,
        Z=observed.along(z)[1],
        lags=lags,
        essential=essential_names(ls.essential, estimate, within),
    )


@np.errstate(over="ignore", invalid="ignore")  # a start may be anything
def assess_pass(estimate: Estimate, z: Instruments, system: System, tolerance_percent: float) -> Pass:
    """A pass that led from the parameters asked for to `estimate`, and whether it settled.

    `system` has all parameters and the rows that this pass used.

    The estimate is compared with what was asked for, not with what was simulated in its place. Both must hold: the residual
    norm changed by less than the tolerance, and each parameter by less than the tolerance or half its deviation, whichever is
    larger. Parameters near zero never settle in percent of themselves.
    """
    tolerance = 0.01 * tolerance_percent
    old = np.array([z.beta[system.names.index(name)] for name in estimate.names])
    change = np.abs(estimate.beta - old)
    w = estimate.weights[system.joint_of_row] * system.used
    norm_before = float(np.linalg.norm(w * (system.Y - system.W @ z.beta)))
    norm_change = abs(estimate.residual_norm - norm_before)
    with np.errstate(divide="ignore", invalid="ignore"):
        in_sigma = np.where(change > 0, change / estimate.sigma, 0.0)
        in_percent = np.where(np.abs(estimate.beta) > 2 * estimate.sigma, 100 * change / np.abs(estimate.beta), 0.0)
    return Pass(
        instruments=z.kind,
        reason=z.reason,
        residual_norm=estimate.residual_norm,
        change_sigma=float(in_sigma.max()),
        change_percent=float(in_percent.max()),
        changed=estimate.names[int(in_sigma.argmax())],
        gains=z.gains,
        tracking_percent=z.tracking_percent,
        condition=estimate.condition_number_scaled,
        residual_percent=100 * norm_change / norm_before if norm_before > 0 else 0.0,
        residual_settled=norm_change <= tolerance * norm_before,
        parameters_settled=bool((change <= np.maximum(tolerance * np.abs(estimate.beta), estimate.sigma / 2)).all()),
    )


def _tests(system: System, estimate: Estimate, rho: Array, used: Array) -> InstrumentTests:
    """Tests of instruments that gave an estimate from a system; it leaves rho (rows, n), of which some are `used` (r,)."""
    among = np.array([system.names.index(name) for name in estimate.names])
    W, Y = system.with_columns(among).weighted(estimate.weights)
    weighted = rho * estimate.weights * used.reshape(len(estimate.weights), -1).T
    return instrument_tests(estimate.Q, W, Y, estimate.rows, lag_one(weighted) or 0.0)


def _direct_errors(replicas: tuple[Replica, ...]) -> tuple[DirectModelError, ...]:
    """Errors of the simulated robot by joint, of the recording that is worst; none where one could not be simulated."""
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
    """The largest of those that there are: a joint may stand in one recording, or have no torque."""
    return max((x for x in percents if x is not None), default=None)


def _status(
    passes: tuple[Pass, ...],
    final_reason: str | None,
    tracking_percent: float | None,
    failure: str | None,
    direct: tuple[DirectModelError, ...],
    tests: InstrumentTests,
) -> tuple[Status, str | None]:
    """`converged` is only said of an estimate that settled, along simulated instruments that explain W, and that tracks.

    One that settled otherwise is `not_confirmed`. Every joint has to track, not the robot on average: a joint of small travel
    would hide behind the others.
    """
    if failure is not None:
        return "diverged", failure
    if not tests.first_stage_F >= 1.0:
        return "diverged", f"the instruments do not explain the regressor: first-stage F = {tests.first_stage_F:.2g}"
    last, unconfirmed = passes[-1], _unconfirmed(final_reason, tracking_percent, direct)
    if last.settled:
        if unconfirmed is None and last.instruments != "simulated":
            unconfirmed = f"settled without simulated instruments: {last.reason}"
        return ("converged", None) if unconfirmed is None else ("not_confirmed", unconfirmed)
    if unconfirmed is not None:
        return "diverged", unconfirmed
    moving = []
    if not last.parameters_settled:
        moving.append(f"{last.changed} still changes by {last.change_sigma:.2g} sigma")
    if not last.residual_settled:
        moving.append(f"the residual norm still changes by {last.residual_percent:.2g} %")
    return "max_iterations", f"after {len(passes)} passes " + " and ".join(moving)


def _unconfirmed(
    final_reason: str | None, tracking_percent: float | None, direct: tuple[DirectModelError, ...]
) -> str | None:
    """Why the robot simulated with the final estimate does not vouch for it, or None where it does."""
    if final_reason is not None:
        return f"the final estimate cannot be simulated: {final_reason}"
    if tracking_percent is None or not tracking_percent <= TRACKED_PERCENT:
        return "the simulated position does not follow the measured one"
    for d in direct:
        if d.position_error_percent is not None and not d.position_error_percent <= TRACKED_PERCENT:
            return f"simulated joint {d.name} is {d.position_error_percent:.1f} % off the measured one"
    return None


def _iv_warnings(replicas: tuple[Replica, ...], tests: InstrumentTests) -> tuple[str, ...]:
    warnings = []
    if any(one.reference_kind == "surrogate" for one in replicas):
        warnings.append(
            "surrogate reference: the recording has none, the measured position stands in; the instruments are not "
            "strictly exogenous"
        )
    if without := [one.bandwidth_hz for one in replicas if not one.described]:
        warnings.append(f"surrogate controller: none is described, a PD of {without[0]:g} Hz stands in")
    if unknown := [one.bandwidth_hz for one in replicas if one.described and not one.J_known]:
        warnings.append(
            "least squares gives no positive inertias: those that the described gains suit at "
            f"{unknown[0]:g} Hz stand in for the gain update"
        )
    saturated = _largest([one.saturated_percent for one in replicas])
    if saturated is not None and saturated > SATURATED_PERCENT:
        warnings.append(f"a drive is saturated in {saturated:.1f} % of the samples")
    if tests.first_stage_F < WEAK_INSTRUMENTS_F:
        warnings.append(f"weak instruments: first-stage F = {tests.first_stage_F:.2g}, below {WEAK_INSTRUMENTS_F:g}")
    return tuple(warnings)
