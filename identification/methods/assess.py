"""Assesses a fit: torque errors, intervals, tests and warnings; with instruments also those and
the status of the passes: how they ended, and whether the simulated robot confirms the estimate.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import get_args

import numpy as np

from ..arrays import Array
from ..estimation import (
    Estimate,
    autocorrelation,
    f_test,
    moves_of,
    relative_residual,
    spans_of,
    torque_errors,
)
from ..model import direct_model, why_not_positive
from ..regression import (
    ROWS,
    Lag,
    Problem,
    Rows,
    base_name,
    sample_weights,
)
from ..report import DirectModelResidual, FTest, Method, Status
from ..simulation import ControllerKind, Simulated
from ..trust import (
    MIN_FIRST_STAGE_F,
    FitData,
    trust_in,
    with_predictions,
)
from .fit import Fit, FittedRecording, Pass, essential_names, join_reasons
from .gains import held_and_counted, with_gains_and_payloads
from .iteration import MIN_F, Loop
from .model import Model
from .recording_report import gain_warnings

SURROGATE = (
    "surrogate reference: none recorded, the measured position is used instead; the instruments "
    "are not strictly exogenous"
)
# a larger error of the simulated position does not confirm the estimate
MAX_TRACKING_PERCENT = 20.0
MAX_SATURATED_PERCENT = 1.0  # of the samples: above, a warning


def evidence_of(
    model: Model,
    method: Method,
    solved: Pass,
    x: Array,
    full: Estimate,
    essential: FTest,
) -> FitData:
    """Inputs of the trust tests of a solution and its x (p,), with the columns of candidates in
    its rows; `full`, `essential`: least squares of all parameters, and those essential by it.
    """
    estimate, unknowns, rows = solved.estimate, model.unknowns, solved.rows
    assert rows is not None
    candidates, *_ = model.candidates(x, (rows.speed, rows.most), simulated=not rows.recorded)
    lags = counted_lags(model, solved.lags, rows, estimate)
    within = held_and_counted(model, estimate, rows, lags)
    return FitData(
        problems=model.concluded(x),
        arms=unknowns.arms,
        observed=rows,
        method=method,
        fixed_point=True,
        estimate=estimate,
        predicted=solved.tau_predicted,
        intervals=within,
        least_squares=full,
        candidates=candidates,
        lags=lags,
        essential=essential_names(essential, estimate, within),
    )


def counted_lags(
    model: Model, lags: Sequence[Lag], rows: Rows, estimate: Estimate
) -> tuple[Lag, ...]:
    """The lags with their recordings, and the moves of an estimate by one deviation of each."""
    moves, found = moves_of(rows.system, rows.L[:, -len(lags) :], estimate), []
    for lag, group, move in zip(lags, model.unknowns.groups, moves.T, strict=True):
        names = tuple(model.problems[k].signals.recording for k in group)
        found.append(replace(lag, moved=lag.sd_s * np.abs(move), recordings=names))
    return tuple(found)


def fit_of(
    model: Model,
    evidence: FitData,
    x: Array,
    ls: Pass,
    essential: FTest,
    z: Sequence[Simulated] = (),
) -> Fit:
    """The fit of an estimate and its x (p,), and its assessment; `ls`: least squares, and the
    `essential` parameters by it; `z`: the robot simulated in each recording, if it was.
    """
    names = tuple(joint.name for joint in model.problem.signals.robot.joints)
    evidence, (tau, predicted, counts, t_s) = with_predictions(
        evidence, partial(model.torques, x, judged=True)
    )
    parts = zip(evidence.problems, spans_of([*map(len, t_s)]), strict=True)
    fitted = [
        FittedRecording(
            problem=problem,
            arm=model.unknowns.arms[k].settled(evidence.estimate),
            rows=part,
            errors=torque_errors(tau[part], predicted[part], counts[part], names),
            held_out=evidence.by_others[k] if evidence.by_others else None,
            simulated=z[k] if z else None,
        )
        for k, (problem, part) in enumerate(parts)
    ]
    fit = Fit(
        recordings=tuple(fitted[k] for k in model.order),
        method=evidence.method,
        status="solved",
        estimate=evidence.estimate,
        intervals=evidence.intervals,
        least_squares=ls,
        essential=essential,
        t_s=np.concatenate(t_s),
        tau=tau,
        tau_predicted=predicted,
        counts=counts,
        errors=torque_errors(tau, predicted, counts, names),
        warnings=_warnings(model),
        trust=trust_in(evidence),
        data=evidence,
        own=own_test(model, x, evidence.least_squares),
    )
    return fit if model.unknowns.plain else with_gains_and_payloads(model, fit)


def own_test(model: Model, x: Array, full: Estimate) -> FTest | None:
    """F test, by least squares, of the recordings' own parameters against shared ones;
    None if there are none.
    """
    if not (own := model.unknowns.own):
        return None
    names, x = full.names, model.x_of(full, x)
    rows = model.rows(x)
    W, Y = rows.of(model.unknowns.arm).weighted(full.weights)
    shared = list(dict.fromkeys(map(base_name, names)))
    merge = np.array([[float(base_name(name) == one) for one in shared] for name in names])
    norm, left = (relative_residual(A, Y) for A in (W, W @ merge))
    rho = (rows.tau - model.predicted(x, full)) * full.weights * rows.counts
    extra, freedom = len(names) - len(shared), full.rows - len(names)
    F = (left**2 - norm**2) / extra / (norm**2 / freedom) if norm > 0 else float("inf")
    return f_test(own, F, extra, full.rows, len(names), autocorrelation(rho) or 0.0)


def _warnings(model: Model) -> tuple[str, ...]:
    """Warnings of the settings and the recordings; several recordings may share one."""
    problems = [model.problems[k] for k in model.order]
    of_settings = [
        [*p.for_errors.settings.warnings, *_short_moves(p), *gain_warnings(p.signals)]
        for p in problems
    ]
    named = [
        f"{p.signals.recording}: " * (len(problems) > 1) + f"recording: {event.text}"
        for p in problems
        for event in p.signals.events
        if event.kind == "warning"
    ]
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
    loop: Loop,
    best: Pass,
    passes: Sequence[Pass],
    ended: tuple[Status, str | None],
    tests: tuple[float, float],
) -> Fit:
    """The fit of the pass that is returned, how the passes `ended`, and the `tests` of its
    instruments; the robot simulated with its estimate validates the direct model.
    """
    model, estimate, z, rows = loop.model, best.estimate, best.confirmed_by, best.rows
    assert rows is not None
    x = model.x_of(estimate, best.x)
    tau, (predicted,), *_ = model.torques(x)
    solved = replace(best, rows=replace(rows, tau=tau, late=None), tau_predicted=predicted)
    evidence = evidence_of(model, "iv", solved, x, loop.start.estimate, loop.essential)
    (status, reason), (strength, F) = ended, tests
    if reason is not None and best.number != len(passes):
        reason += f"; pass {best.number} is returned: it tracks best"
    evidence = replace(
        evidence,
        fixed_point=status in ("converged", "not_confirmed"),
        first_stage_F=F,
        unconfirmed=None if status == "converged" else f"status {status}: {reason}",
        by_reference=reason if status == "converged" else None,
    )
    fit = fit_of(model, evidence, x, loop.ls, loop.essential, z)
    warnings = (*fit.warnings, *_iv_warnings(model, z, F))
    return replace(
        fit,
        status=status,
        warnings=warnings,
        start=loop.iteration.start,
        passes=tuple(passes),
        returned=best.number,
        reason=reason,
        controller=max((one.controller for one in z), key=get_args(ControllerKind).index),
        strength=strength,
        saturated_percent=largest([max(one.saturated.values(), default=None) for one in z]),
        direct=direct_errors(z),
    )


def _iv_warnings(model: Model, z: Sequence[Simulated], first_stage_F: float) -> tuple[str, ...]:
    each = list(zip((problem.signals.robot for problem in model.problems), z, strict=True))
    without = [robot for robot, one in each if one.controller == "surrogate"]
    unknown = [
        robot for robot, one in each if one.controller != "surrogate" and not one.prior_known
    ]
    limits = (
        ", ".join(
            f"{m} in {x:.1f} %" for m, x in one.saturated.items() if x > MAX_SATURATED_PERCENT
        )
        for one in z
    )
    return (
        *([] if model.exogenous else [SURROGATE]),
        *(
            f"no controller described: simulated with a {robot.bandwidth_hz:g} Hz PD instead"
            for robot in without[:1]
        ),
        *(
            "least squares gives no positive inertias: the gain update uses those that suit the "
            f"described gains at {robot.bandwidth_hz:g} Hz"
            for robot in unknown[:1]
        ),
        *(f"drives at their limit: {found} of the samples" for found in limits if found),
        *(
            f"weak instruments: first-stage F = {F:.2g}, below {MIN_FIRST_STAGE_F:g}"
            for F in [first_stage_F]
            if F < MIN_FIRST_STAGE_F
        ),
    )


def status_of(
    model: Model, last: Pass, best: Pass, first_stage_F: float
) -> tuple[Status, str | None]:
    """`converged` needs settled passes, simulated instruments that explain W, and a simulation
    that tracks the recording; or instruments along the motion that the reference predicts which
    stand alone, and explain W.

    Other settled passes are `not_confirmed`. Every joint has to track: the mean over the robot
    would hide a joint of small travel.
    """
    unconfirmed = None if best.by_reference else _unconfirmed(model, best)
    if last.failure is not None:
        return "diverged", last.failure
    if not first_stage_F >= MIN_F:
        return (
            "diverged",
            "the simulated motion does not resemble the measured one: first-stage "
            f"F = {first_stage_F:.2g}",
        )
    if best.by_reference:
        return "converged", f"instruments: reference; {best.by_reference}"
    if last.is_last:
        if unconfirmed is None and last.kind != "simulated":
            unconfirmed = f"settled without simulated instruments: {last.reason}"
        return ("converged", None) if unconfirmed is None else ("not_confirmed", unconfirmed)
    if unconfirmed is not None:
        return "diverged", unconfirmed
    moving = []
    if not last.parameters_settled:
        moving.append(f"{last.changed} still changes by {last.change_sigma:.2g} sigma")
    if not last.residual_settled:
        moving.append(f"the residual norm still changes by {last.residual_percent:.2g} %")
    still = " and ".join(moving) or "only the start is known"
    return "max_iterations", f"after {last.number} passes {still}"


def _unconfirmed(model: Model, best: Pass) -> str | None:
    """Why the simulation with the final estimate does not confirm it; None if it does."""
    reasons, x = list[tuple[str, str | None]](), model.x_of(best.estimate, best.x)
    for one in model.equations:
        problem = one.problem
        chi = problem.base.standard_parameters(one.arm.beta(x))
        M = direct_model(problem.model, chi).inertia(problem.poses)
        reasons.append((problem.signals.recording, why_not_positive(M)))
    if (reason := join_reasons(reasons)) is not None:
        return f"the final estimate cannot be simulated: {reason}"
    percents = [np.inf if one.percent is None else one.percent for one in best.confirmed_by]
    if not max(percents) <= MAX_TRACKING_PERCENT:
        return "the simulated position does not follow the measured one"
    for d in direct_errors(best.confirmed_by):
        if (
            d.position_error_percent is not None
            and not d.position_error_percent <= MAX_TRACKING_PERCENT
        ):
            return (
                f"simulated joint {d.name} differs by {d.position_error_percent:.1f} % from "
                "the measured one"
            )
    return None


def direct_errors(z: Sequence[Simulated]) -> tuple[DirectModelResidual, ...]:
    """Largest errors of the simulated robot in any recording, by joint; none if one
    could not be simulated.
    """
    return tuple(
        DirectModelResidual(
            name=joint[0].name,
            position_error_percent=largest([d.position_error_percent for d in joint]),
            torque_error_percent=largest([d.torque_error_percent for d in joint]),
        )
        for joint in zip(*(one.by_joint for one in z), strict=False)
    )


def largest(percents: list[float | None]) -> float | None:
    """The largest that is not None: a joint may stand in one recording, or have no torque."""
    return max((x for x in percents if x is not None), default=None)
