"""Assesses the instrumental variable method: each pass, the instruments, the direct model, and whether it converged."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..estimation import Estimate, InstrumentTests, System, instrument_tests, lag_one
from ..report import Status
from ..simulation import DirectModelError, Replica, told, worst
from ..trust import Evidence
from .assess import fit_of, intervals_along, sums_along
from .fit import Fit, InstrumentEvidence, LeastSquares, Pass, essential_names
from .system import StackedSystem
from .timing import counted

TRACKED_PERCENT = 20.0  # a simulation further off the measured position does not vouch for its estimate
SATURATED_PERCENT = 1.0  # a share of saturated samples worth a warning
WEAK_INSTRUMENTS_F = 10.0


def assess_iv(
    observed: StackedSystem,
    best: Pass,
    beginning: tuple[StackedSystem, Pass] | None,
    ls: LeastSquares,
    passes: Sequence[Pass],
    start: str,
) -> Fit:
    """A fit by instruments; the robot simulated with its estimate is the direct model's validation."""
    observed, z, estimate, replicas = observed.about(best.z), best.z, best.estimate, best.replicas
    evidence, (system, _) = _evidence_along(observed, best, ls), observed.along(z)
    tests = _tests(system, estimate, observed.regression.tau - evidence.predicted, z.used)
    status, reason = _status(passes, best, [one.problem.signals.recording for one in observed.observations], tests)
    if reason is not None and best.number != len(passes):
        reason += f"; pass {best.number} is returned, which tracks best"
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.nan_to_num(np.abs(ls.full.among(estimate.names) - estimate.beta) / evidence.intervals.half)
    first = replicas[observed.order[0]]
    iv = InstrumentEvidence(
        start=start,
        reference="recorded" if all(one.reference_kind == "recorded" for one in replicas) else "surrogate",
        controller="described" if all(one.described for one in replicas) else "surrogate",
        passes=tuple(passes),
        returned=best.number,
        reason=reason,
        tests=tests,
        contrast=float(apart.max()),
        contrast_at=estimate.names[int(apart.argmax())],
        rows_used_percent=float(100 * z.used.mean()),
        saturated_percent=_largest([one.saturated_percent for one in replicas]),
        direct=_direct_errors(replicas),
        simulated=first.motion,
        q=first.q,
    )
    evidence = replace(
        evidence,
        Z=None if observed.regression.reduced else evidence.Z,
        fixed_point=status in ("converged", "not_confirmed"),
        first_stage_F=tests.first_stage_F,
        unconfirmed=None if status == "converged" else f"status {status}: {reason}",
        factors=z.factors if len(z.factors) > 1 else (),
        blocks=sums_along(z, estimate),
        looked_at=None if beginning is None else _evidence_along(*beginning, ls),
    )
    own = replace(ls, estimate=estimate, intervals=evidence.intervals, tau_predicted=evidence.predicted)
    fit = fit_of(observed, evidence, own, replicas)
    warnings = (*fit.warnings, *_iv_warnings(replicas, tests))
    return replace(fit, status=status, iv=iv, least_squares=ls, warnings=warnings)


def _evidence_along(observed: StackedSystem, best: Pass, ls: LeastSquares) -> Evidence:
    """What an estimate by instruments rests on, in its rows."""
    observed, z, estimate = observed.about(best.z), best.z, best.estimate
    within = counted(estimate, intervals_along(observed, z, estimate), observed.lags)
    return Evidence(
        recordings=observed.simulated(best.replicas),
        observed=observed.regression,
        method="iv",
        fixed_point=True,
        estimate=estimate,
        predicted=observed.predicted(estimate),
        used=z.used,
        intervals=within,
        least_squares=ls.full,
        Z=observed.along(z)[1],
        lags=observed.lags,
        essential=essential_names(ls.essential, estimate, within),
    )


def _tests(system: System, estimate: Estimate, rho: Array, used: Array) -> InstrumentTests:
    """Tests of instruments that gave an estimate from a system; it leaves rho (rows, n), of which some are `used` (r,)."""
    among = np.array([system.names.index(name) for name in estimate.names])
    W, Y = system.with_columns(among).weighted(estimate.weights)
    weighted = rho * estimate.weights * used.reshape(len(estimate.weights), -1).T
    return instrument_tests(estimate.Q, W, Y, estimate.rows, lag_one(weighted) or 0.0)


def _direct_errors(replicas: Sequence[Replica]) -> tuple[DirectModelError, ...]:
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
    passes: Sequence[Pass], best: Pass, recordings: Sequence[str], tests: InstrumentTests
) -> tuple[Status, str | None]:
    """`converged` is only said of an estimate that settled, along simulated instruments that explain W, and that tracks.

    One that settled otherwise is `not_confirmed`. Every joint has to track, not the robot on average: a joint of small travel
    would hide behind the others.
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
    """Why the robot simulated with the final estimate does not vouch for it, or None where it does."""
    reason = told([one.reason for one in replicas], recordings)
    if reason is not None:
        return f"the final estimate cannot be simulated: {reason}"
    tracking_percent = worst([one.tracking_percent for one in replicas])
    if tracking_percent is None or not tracking_percent <= TRACKED_PERCENT:
        return "the simulated position does not follow the measured one"
    for d in _direct_errors(replicas):
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
