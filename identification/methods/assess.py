"""Assesses a fit: torque errors, intervals, tests and warnings; with instruments also those and
the status of the passes.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..errors import NoFitError
from ..estimation import (
    Estimate,
    InstrumentTests,
    autocorrelation,
    f_tests,
    spans_of,
    torque_errors,
)
from ..regression import ROWS, Problem, Rows, base_name, sample_weights
from ..report import FTest, Method
from ..simulation import Simulated, controller_of, saturated_percents
from ..trust import Candidates, FitData, held_out_parts, trust_in, with_prior
from .equations import Equations
from .fit import Fit, FittedRecording, InstrumentEvidence, LeastSquares, Pass, essential_names
from .gains import held_and_counted, results_of
from .iteration import direct_errors, largest, status_of, tests_of
from .recording_report import gain_warnings, recording_warnings
from .timing import lags_of

MAX_SATURATED_PERCENT = 1.0  # of the samples: above, a warning
MIN_FIRST_STAGE_F = 10.0


def evidence_of(
    equations: Equations,
    method: Method,
    solved: LeastSquares,
    each: Sequence[Rows],
    *,
    tau: Array | None = None,
    z: Sequence[Simulated] = (),
) -> FitData:
    """Inputs of the trust tests of an estimate from its rows, of each recording, with the columns
    of candidates; `tau` (rows, n) replaces their torques.
    """
    estimate, rows = solved.estimate, equations.stacked(each)
    if tau is not None:
        rows = replace(rows, tau=tau)
    # Rows have the columns of before their simulation.
    candidates = candidates_of(equations, estimate.values_of(equations.names), simulated=bool(z))
    lags = lags_of(equations, rows, estimate)
    within = held_and_counted(equations, estimate, each, rows.system, lags)
    return FitData(
        problems=tuple(equations.with_sources()),
        arms=equations.unknowns.arms,
        replays=tuple(line for line, _ in equations.replays),
        observed=rows,
        method=method,
        fixed_point=True,
        estimate=estimate,
        predicted=solved.tau_predicted,
        intervals=within,
        least_squares=solved.full,
        candidates=candidates,
        lags=lags,
        essential=essential_names(solved.essential, estimate, within),
    )


def candidates_of(
    equations: Equations, x: Array, *, simulated: bool = False
) -> tuple[Candidates, ...]:
    """By recording the terms that are not in the model, about x, along the measured or the
    simulated motion.
    """
    simulated &= all(problem.signals.q_ref is not None for problem in equations.problems)
    speed = equations.speed
    sliding = np.abs(speed @ equations.problem.model.coulomb_directions.T)
    return tuple(
        Candidates(
            problem=problem,
            beta=equations.unknowns.beta(x, k),
            peak=np.abs(speed).max(axis=0),
            sliding=sliding.max(axis=0),
            simulated=simulated,
            gains=bool(equations.unknowns.motors),
        )
        for k, problem in enumerate(equations.tasks())
    )


def fit_of(
    equations: Equations, evidence: FitData, solved: LeastSquares, z: Sequence[Simulated] = ()
) -> Fit:
    """The fit of an estimate and its assessment; `z`: the robot simulated in each recording,
    if it was.
    """
    rows, predicted = evidence.observed, solved.tau_predicted
    names = tuple(joint.name for joint in equations.problem.signals.robot.joints)
    evidence = replace(evidence, held_out=held_out_parts(evidence, equations.predicted))
    evidence = with_prior(evidence, equations.predicted)
    filtered, warnings = equations, _warnings(equations)
    measured, of_model, speed = rows.tau, predicted, rows.speed
    try:  # errors of the model, without the noise that passes the cut-off of the fit
        if (behind := equations.behind_rule()) is not None:
            filtered, (measured, of_model, speed) = behind, behind.torques(solved.estimate)
    except NoFitError as error:
        warnings += (f"errors include noise above the rule's cut-off: {error.args[0]}",)
    of_filtered = spans_of([len(problem.settings.instants) for problem in filtered.problems])
    parts = zip(equations.problems, spans_of(rows.parts), of_filtered, strict=True)
    fitted = [
        FittedRecording(
            problem=problem,
            arm=equations.unknowns.arms[k].settled(solved.estimate),
            rows=part,
            errors=torque_errors(
                measured[own],
                of_model[own],
                speed[own],
                filtered.problems[k].measured_rows(),
                names,
            ),
            held_out=evidence.held_out[k]
            if len(equations.problems) > 1 and not evidence.gains
            else None,
            simulated=z[k] if z else None,
        )
        for k, (problem, part, own) in enumerate(parts)
    ]
    fit = Fit(
        recordings=tuple(fitted[k] for k in equations.order),
        method=evidence.method,
        status="solved",
        estimate=solved.estimate,
        intervals=solved.intervals,
        least_squares=solved.of_base(),
        t_s=np.concatenate([problem.row_times_s() for problem in equations.tasks()]),
        tau=rows.tau,
        tau_predicted=predicted,
        speed=rows.speed,
        errors=torque_errors(
            measured,
            of_model,
            speed,
            np.concatenate([x.measured_rows() for x in filtered.problems]),
            names,
        ),
        warnings=warnings,
        trust=trust_in(evidence),
        data=evidence,
        own=own_test(equations.with_motors(()), solved.full),
    )
    if equations.unknowns.plain:
        return fit
    fit = replace(fit, **results_of(equations, evidence))
    far = [one.recording for one in fit.payloads if not one.near]
    text = "no body of positive density is near: its values are stated or a ball's"
    return replace(fit, warnings=(*fit.warnings, *(f"payload of {name}: {text}" for name in far)))


def own_test(equations: Equations, full: Estimate) -> FTest | None:
    """F test, by least squares, of the recordings' own parameters against shared ones;
    None if there are none.
    """
    names, own = equations.names, equations.unknowns.own
    if not own:
        return None
    rows = equations.about(full.values_of(names))
    W, Y = rows.system.weighted(full.weights)
    shared = list(dict.fromkeys(map(base_name, names)))
    merge = np.array([[float(base_name(name) == one) for one in shared] for name in names])
    scaled = [A / np.linalg.norm(A, axis=0) for A in (W, W @ merge)]
    norm, left = (float(np.linalg.norm(Y - A @ np.linalg.lstsq(A, Y)[0])) for A in scaled)
    rho = (rows.tau - equations.predicted(full)) * full.weights * rows.counts
    extra, freedom = len(names) - len(shared), full.rows - len(names)
    F = (left**2 - norm**2) / extra / (norm**2 / freedom) if norm > 0 else float("inf")
    F, p, F_effective, p_effective = f_tests(
        F, extra, full.rows, len(names), autocorrelation(rho) or 0.0
    )
    return FTest(names=own, F=F, p_value=p, F_effective=F_effective, p_effective=p_effective)


def _warnings(equations: Equations) -> tuple[str, ...]:
    """Warnings of the settings and the recordings; several recordings may share one."""
    problems = [equations.problems[k] for k in equations.order]
    of_settings = [
        [*p.settings.warnings, *_short_moves(p), *gain_warnings(p.signals)] for p in problems
    ]
    if len(problems) == 1:
        return (*of_settings[0], *recording_warnings(problems[0].signals))
    named = [
        f"{p.signals.recording}: {text}" for p in problems for text in recording_warnings(p.signals)
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
    equations: Equations, best: Pass, ls: LeastSquares, passes: Sequence[Pass], start: str
) -> Fit:
    """The fit of the pass that is returned; the robot simulated with its estimate
    validates the direct model.
    """
    estimate, z = best.estimate, best.confirmed_by
    tau, predicted, _ = equations.torques(estimate)
    solved = replace(ls, estimate=estimate, tau_predicted=predicted)
    evidence = evidence_of(equations, "iv", solved, equations.rows_with(best.z), tau=tau, z=z)
    tests = tests_of(evidence.observed.system, estimate)
    status, reason = status_of(equations, passes, best, tests)
    if reason is not None and best.number != len(passes):
        reason += f"; pass {best.number} is returned: it tracks best"
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.abs(ls.full.values_of(estimate.names) - estimate.beta) / evidence.intervals.half
        contrast = np.nan_to_num(np.where(np.isin(estimate.names, ls.full.names), off, 0.0))
    saturated = [saturated_percents(problem.with_samples()) for problem in equations.tasks()]
    controllers = [controller_of(problem)[1] for problem in equations.problems]
    iv = InstrumentEvidence(
        start=start,
        reference="recorded"
        if all(problem.signals.q_ref is not None for problem in equations.problems)
        else "surrogate",
        controller=max(controllers, key=("described", "found", "surrogate").index),
        passes=tuple(passes),
        returned=best.number,
        reason=reason,
        tests=tests,
        contrast=float(contrast.max()),
        contrast_at=estimate.names[int(contrast.argmax())],
        rows_used_percent=float(100 * evidence.observed.counts.mean()),
        saturated_percent=largest([max(one.values(), default=None) for one in saturated]),
        direct=direct_errors(z),
    )
    evidence = replace(
        evidence,
        fixed_point=status in ("converged", "not_confirmed"),
        first_stage_F=tests.first_stage_F,
        unconfirmed=None if status == "converged" else f"status {status}: {reason}",
        by_reference=reason if status == "converged" else None,
    )
    fit = fit_of(equations, evidence, replace(solved, intervals=evidence.intervals), z)
    warnings = (*fit.warnings, *_iv_warnings(equations, z, controllers, saturated, tests))
    return replace(fit, status=status, iv=iv, least_squares=ls.of_base(), warnings=warnings)


def _iv_warnings(
    equations: Equations,
    z: Sequence[Simulated],
    controllers: Sequence[str],
    saturated: Sequence[dict[str, float]],
    tests: InstrumentTests,
) -> tuple[str, ...]:
    warnings, robots = [], [problem.signals.robot for problem in equations.problems]
    each = list(zip(robots, controllers, z, strict=True))
    without = [robot for robot, controller, _ in each if controller == "surrogate"]
    unknown = [
        robot
        for robot, controller, one in each
        if controller != "surrogate" and not one.prior_known
    ]
    if any(problem.signals.q_ref is None for problem in equations.problems):
        warnings.append(
            "surrogate reference: none recorded, the measured position is used instead; the "
            "instruments are not "
            "strictly exogenous"
        )
    if without:
        warnings.append(
            f"no controller described: simulated with a {without[0].bandwidth_hz:g} Hz PD instead"
        )
    if unknown:
        warnings.append(
            "least squares gives no positive inertias: the gain update uses those that suit the "
            "described gains at "
            f"{unknown[0].bandwidth_hz:g} Hz"
        )
    for shares in saturated:
        at_limit = (
            f"{name} in {x:.1f} %" for name, x in shares.items() if x > MAX_SATURATED_PERCENT
        )
        if found := ", ".join(at_limit):
            warnings.append(f"drives at their limit: {found} of the samples")
    if tests.first_stage_F < MIN_FIRST_STAGE_F:
        warnings.append(
            f"weak instruments: first-stage F = {tests.first_stage_F:.2g}, below "
            f"{MIN_FIRST_STAGE_F:g}"
        )
    return tuple(warnings)
