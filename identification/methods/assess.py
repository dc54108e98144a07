"""Assesses an estimate: torque errors of all rows, robust deviations, tests, warnings."""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..data import Signals
from ..errors import IdentificationError
from ..estimation import (
    Estimate,
    Intervals,
    hac_sigma,
    intervals,
    torque_errors,
)
from ..regression import Problem, Regression, torque_of_recording
from ..simulation import has_controller, recorded_loop
from ..trust import Evidence, trust_in
from .fit import Fit, InstrumentEvidence, LeastSquares, Method, Rows, Status


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdict:
    """How a method ended, and what it adds to a fit."""

    status: Status = "solved"
    iv: InstrumentEvidence | None = None
    warnings: tuple[str, ...] = ()


def evidence_of_ls(problem: Problem, observed: Regression, method: Method, ls: LeastSquares) -> Evidence:
    """What least squares has to show for itself: it has no instruments."""
    used, robot, loop = observed.system.used, problem.signals.robot, None
    if has_controller(robot.controller):
        with suppress(IdentificationError):  # described in part: least squares does without
            loop = recorded_loop(robot)
    return Evidence(
        problem=problem,
        observed=observed,
        method=method,
        fixed_point=True,
        estimate=ls.estimate,
        used=used,
        intervals=ls.intervals,
        least_squares=ls.full,
        loop=loop,
    )


def assess_ls(evidence: Evidence, ls: LeastSquares) -> Fit:
    """A fit by least squares."""
    return _fit(evidence, ls, Verdict())


def assess_estimate(evidence: Evidence, ls: LeastSquares, predicted: Array, verdict: Verdict) -> Fit:
    """A fit by instruments, with the torque (rows, n) it predicts; least squares of the same rows stands beside it."""
    observed, estimate = evidence.observed, evidence.estimate
    sigma_hac = robust_sigma(observed, estimate, predicted, evidence.used)
    own = replace(ls, estimate=estimate, sigma_hac=sigma_hac, intervals=evidence.intervals, tau_predicted=predicted)
    return replace(_fit(evidence, own, verdict), least_squares=ls)


def _fit(evidence: Evidence, solved: LeastSquares, verdict: Verdict) -> Fit:
    problem, observed = evidence.problem, evidence.observed
    settings, signals = problem.settings, problem.signals
    # Decimation keeps the last sample and every n_d-th before it.
    kept = settings.stop - 1 - settings.decimation * np.arange(len(observed.tau))[::-1]
    names = tuple(joint.name for joint in signals.robot.joints)
    return Fit(
        problem=problem,
        method=evidence.method,
        status=verdict.status,
        estimate=solved.estimate,
        sigma_hac=solved.sigma_hac,
        intervals=solved.intervals,
        least_squares=solved,
        rows=Rows(t_s=signals.t_s[kept], tau=observed.tau, tau_predicted=solved.tau_predicted, speed=observed.speed),
        errors=torque_errors(observed.tau, solved.tau_predicted, observed.speed, names),
        warnings=_warnings(problem, verdict.warnings),
        trust=trust_in(evidence),
        iv=verdict.iv,
    )


def predicted_rows(problem: Problem, observed: Regression, estimate: Estimate) -> Array:
    """Decimated torque (rows, n) that an estimate predicts for the rows of `observed`."""
    if observed.reduced:
        return torque_of_recording(problem, estimate.among(problem.base.names))[1]
    return np.asarray((columns_of(observed, estimate) @ estimate.beta).reshape(observed.tau.shape[1], -1).T)


def columns_of(observed: Regression, estimate: Estimate) -> Array:
    """Columns of W (r, b) of the parameters estimated."""
    names = observed.system.names
    return observed.system.W[:, [names.index(name) for name in estimate.names]]


def intervals_of(observed: Regression, estimate: Estimate, predicted: Array, used: Array) -> Intervals:
    """Intervals of an estimate from the rows that are `used` (r,)."""
    if observed.time_blocks is not None:
        return observed.time_blocks.intervals(estimate)
    rho = ((observed.tau - predicted) * estimate.weights).T.reshape(-1)
    return intervals(estimate, rho * used, observed.tau.shape[1])


def robust_sigma(observed: Regression, estimate: Estimate, predicted: Array, used: Array) -> Array:
    """HAC deviations (b,) from the rows that are `used` (r,); NaN where rows are reduced."""
    if observed.reduced:
        return np.full(len(estimate.names), np.nan)
    rho = ((observed.tau - predicted) * estimate.weights).T.reshape(-1)
    return hac_sigma(estimate.Q, estimate.bread, rho * used, observed.tau.shape[1], rows=estimate.rows)


def _warnings(problem: Problem, of_method: tuple[str, ...]) -> tuple[str, ...]:
    signals = problem.signals
    return (
        *problem.settings.warnings,
        *gain_warnings(signals),
        *recording_warnings(signals),
        *of_method,
    )


def recording_warnings(signals: Signals) -> tuple[str, ...]:
    """What the recorder warned of, such as SYNC at another period than described: estimates rest on it."""
    return tuple(f"recording: {event.text}" for event in signals.events if event.kind == "warning")


def gain_warnings(signals: Signals) -> tuple[str, ...]:
    """What a reader must know of the units where the drive gains are not given."""
    robot = signals.robot
    if robot.gain_known:
        return ()
    units = " and ".join(sorted(set(robot.effort_units)))
    text = f"the drive gains are not known: torques and parameters are in {units}, not in N m"
    shared = (
        "; joints share parameters, so the values hold only if all drives have the same gain" if robot.n > 1 else ""
    )
    return (text + shared,)
