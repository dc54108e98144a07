"""Identification by the inverse dynamic model, with least squares or instrumental variables.

Letters and equation numbers are those of Janot2014: A. Janot, P.-O. Vandanjon, M. Gautier, "An instrumental variable
approach for rigid industrial robots identification", Control Engineering Practice 25 (2014) 85-101.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from ..data import Recordings, Signals, check_one_robot
from ..errors import IdentificationError
from ..estimation import (
    Estimate,
    System,
    autocorrelation,
    essential_parameters,
    instrumental_variables,
    intervals_of,
    one_thread,
    torque_errors,
)
from ..regression import Overrides, base_places, make_problem, torque_of_recording
from ..report import FitFile, Method, TorqueError
from ..simulation import Instruments
from ..trust import FitData, covariance_of_all
from .assess import assess_iv, evidence_of_ls, fit_of, position_noise_of
from .fit import Fit, LeastSquares, Pass, essential_names
from .gains import (
    add_scale_variance,
    extended,
    factors_of,
    joint_weights_of,
    measured_instruments,
    motors_of,
    solve_with_gains,
)
from .iteration import (
    Iteration,
    assess_pass,
    conclude,
    failed,
    inertia_prior,
    is_coarse,
    next_values,
    start_values,
)
from .observation import solver_of
from .parameters import payload_beta, stored_beta
from .recording_report import Validated
from .settled import solve_with_load_friction, with_best_ramps
from .system import StackedSystem, stack_of
from .timing import add_lag_variance, correct_known_lags, correct_lags, lags_of_all, lags_of_ls

Say = Callable[[str], None]


def _silent(text: str) -> None:
    pass


def identify(
    signals: Signals | Recordings,
    overrides: Overrides,
    *,
    method: Method | None = None,
    iteration: Iteration | None = None,
    essential: bool = False,
    say: Say = _silent,
) -> Fit:
    """Base parameters beta from measured torque and position.

    Parameters
    ----------
    signals : the recording, or several of one robot; each is filtered and decimated separately.
    overrides : settings that replace those of the description; `Overrides()` for none.
    method : `iv`, instrumental variables; `wls`, least squares with rows weighted by joint; `ols`, without weights. Default:
        `iv` if every recording has its reference, else `wls`.
    iteration : of `iv`: start of the passes, and when they end.
    essential : fit only the essential parameters.
    say : called with a line of text for each step.

    Returns
    -------
    The estimate with its tests. The status of least squares is `solved`; that of `iv` is `converged` only if two passes agree
    and the robot simulated with the estimate follows the recording.

    Raises
    ------
    IdentificationError : a recording is too short, the recordings excite too little or are not of one robot, the first pass
        gives no estimate, or an `iteration` is given to least squares.
    """
    # (2): tau = IDM(q, dq, ddq) beta; (5), (6): Y(tau) = W(q, dq, ddq) beta + rho
    asked = replace(overrides, method="iv" if overrides.gains else method)
    observed = stack_of(signals, asked, say)
    chosen, reason = (method, "asked for") if method is not None else _default_method(observed)
    settings = [one.problem.settings for one in observed.observations]
    low = settings[0].low_speed.iv if "iv" in (asked.method, chosen) else settings[0].low_speed.ls
    if any(one.low_speed_percent != low for one in settings):  # not every recording has its reference
        observed = stack_of(signals, replace(asked, method=chosen), say)
    observed = correct_known_lags(observed)
    if observed.overrides.gains and chosen != "iv" and method is not None:
        text = "least squares is biased towards drive gains of 0"
        raise IdentificationError(text, key="method", value=chosen, expected="iv with --gains")
    observed = with_best_ramps(observed, instruments=chosen == "iv" or bool(overrides.gains))
    if chosen == "iv" or observed.overrides.gains:
        try:
            fit = _by_instruments(observed, iteration or Iteration(), essential=essential, say=say)
        except IdentificationError as error:
            if method is not None or motors_of(observed):
                raise
            raise IdentificationError.of(error, "; least squares: --method wls") from error
    else:
        if iteration is not None:
            raise IdentificationError(
                "only instrumental variables iterate", key="method", value=chosen, expected=f"iv ({reason})"
            )
        fit = _by_least_squares(observed, chosen, essential=essential)
    return replace(fit, method_reason=reason)


def _default_method(observed: StackedSystem) -> tuple[Literal["iv", "wls"], str]:
    """The default method and its reason: instruments if every recording has its reference."""
    without = [one.problem.signals for one in observed.observations if one.problem.signals.q_ref is None]
    if not without:
        return "iv", "reference recorded"
    where = f" in {without[0].recording}" if len(observed.observations) > 1 else ""
    return "wls", f"no reference{where}"


def identify_ls(
    signals: Signals | Recordings,
    overrides: Overrides,
    *,
    method: Literal["ols", "wls"] = "wls",
    essential: bool = False,
    say: Say = _silent,
) -> Fit:
    """IDIM-LS, section 2; parameters as of `identify`."""
    return identify(signals, overrides, method=method, essential=essential, say=say)


def identify_iv(
    signals: Signals | Recordings,
    overrides: Overrides,
    iteration: Iteration,
    *,
    essential: bool = False,
    say: Say = _silent,
) -> Fit:
    """IDIM-IV, section 3; parameters as of `identify`."""
    return identify(signals, overrides, method="iv", iteration=iteration, essential=essential, say=say)


@one_thread
def _by_least_squares(observed: StackedSystem, method: Literal["ols", "wls"], *, essential: bool) -> Fit:
    """IDIM-LS: W and Y from the measured torque and the filtered position."""
    observed, full = solve_with_load_friction(observed, method)
    ls = solve_least_squares(observed, full, essential=essential)
    beginning = None
    if observed.regression.reduced:  # tests that need rows use the beginning
        span, full = solve_with_load_friction(observed.on_span(), method)
        of_span = solve_least_squares(span, full, essential=essential)
        if essential:  # those of the whole recording, whose lags move them
            places = np.flatnonzero(np.isin(span.parameters.names, ls.estimate.names))
            same = solver_of(method)(span.regression.system.with_columns(places))
            of_span = replace(of_span, estimate=same, intervals=intervals_of(span.regression.system, same))
        beginning = evidence_of_ls(span, method, of_span, lags_of_ls(span, of_span.estimate))
    lags = (
        lags_of_ls(observed, ls.estimate)
        if beginning is None
        else lags_of_all(observed, ls.estimate, beginning.lags, beginning.estimate)
    )
    found = add_lag_variance(ls.estimate, ls.intervals, lags)
    ls = replace(ls, intervals=add_scale_variance(observed, ls.estimate, found))
    noise = position_noise_of(observed, method, ls)  # once: it looks at the beginning of a long recording anyway
    evidence = replace(evidence_of_ls(observed, method, ls, lags), beginning=beginning, position_noise=noise)
    return fit_of(observed, evidence, ls)


@one_thread
def _by_instruments(observed: StackedSystem, iteration: Iteration, *, essential: bool, say: Say) -> Fit:
    """IDIM-IV: the instruments Z are the regressor of the robot simulated with the previous estimate.

    W and Y are those of IDIM-LS. Each pass simulates the closed loop with beta_k (same reference, same controller, gains
    updated by beta_k), evaluates Z = IDM of the simulated q, dq, ddq, decimated as W, and solves for beta_k+1.
    """
    if motors := motors_of(observed):
        free, first, settled = solve_with_gains(observed)
        if not settled or _default_method(free)[0] != "iv" or not (factors_of(free, first) > 0).all():
            return _by_measured_motion(free, first, settled=settled, essential=essential)
        observed = free.with_gains(factors_of(free, first)).with_motors(())
        iteration = replace(iteration, start="ls") if iteration.values is None else iteration
    observed, full = solve_with_load_friction(observed)
    ls = solve_least_squares(observed, full, essential=essential)
    prior = inertia_prior(observed, ls)
    beta, C = start_values(observed, iteration, ls)
    if motors:
        observed = observed.with_motors(motors)
        (prior, _), (beta, C) = extended(observed, prior, None), extended(observed, beta, C)
    names, weights = observed.regression.system.names, full.weights
    fitted = np.arange(len(names))
    if essential:
        fitted = np.union1d(ls.essential.kept, np.delete(fitted, base_places(names)))
    lab = observed.lab(prior, gain_update=iteration.gain_update)

    def solve(z: Instruments, system: System) -> Estimate:  # beta = (ZᵀW)⁻¹ ZᵀY
        columns = np.setdiff1d(fitted, observed.load_places()) if z.load_unknown else fitted
        return instrumental_variables(system.with_columns(columns), z.Z[:, columns], weights)

    ls, passes = ls.without_rows(), list[Pass]()
    stored = observed.problem.signals.robot.identification
    most = iteration.max_iterations or stored.max_iterations
    tolerance_percent = iteration.tolerance_percent or stored.tolerance_percent
    while not (passes and passes[-1].is_last) and len(passes) < most:
        number, coarse = len(passes) + 1, is_coarse(observed.problem, iteration.start, passes, most)
        say(f"pass {number}: simulating the robot")
        # Z = IDM(q_sim, dq_sim, ddq_sim)
        z = lab.instruments(beta, C, coarse=coarse)
        about = observed.about(z)
        W_and_Y = about.along(z)
        try:
            estimate = solve(z, W_and_Y)
        except IdentificationError as error:
            passes = failed(passes, z, lab.names, error)
            break
        # C = D R D
        asked, C = C, covariance_of_all(names, estimate, intervals_of(W_and_Y, estimate), ls.full)
        one_pass = assess_pass(z, estimate, W_and_Y, (asked, C), tolerance_percent=tolerance_percent)
        passes = [*(before.without_rows() for before in passes), replace(one_pass, number=number, coarse=coarse)]
        beta = next_values(passes, names)
    if motors:
        observed = observed.with_gains(factors_of(observed, passes[-1].estimate))
        lab = observed.lab(prior, gain_update=iteration.gain_update)
    best = conclude(lab, passes, lambda z: solve(z, observed.along(z)))
    passes = [one.without_rows() for one in passes]
    if motors:
        best = replace(best, estimate=solve(best.z, observed.along(best.z)))
    # Y(tau(t + L)) with the lag L that the same instruments find: no further simulation
    lab_of = partial(StackedSystem.lab, prior=prior, gain_update=iteration.gain_update)
    observed, best, beginning = correct_lags(observed, best, solve, lab_of)
    if motors:  # once more, with the gains about which the lag was found
        observed = observed.with_gains(factors_of(observed, best.estimate))
        best = replace(best, estimate=solve(best.z, observed.along(best.z)))
    return assess_iv(observed, best, beginning, ls, passes, iteration.start)


def _by_measured_motion(observed: StackedSystem, first: Estimate, *, settled: bool, essential: bool) -> Fit:
    """Drive gains and parameters by the fixed point of `solve_with_gains`, where no robot can be simulated."""
    observed, x = observed.with_gains(factors_of(observed, first)), first.values_of(observed.parameters.names)
    x[observed.parameters.gains] = 1.0
    observed = observed.at(x)
    rows, Z = observed.regression, measured_instruments(observed, x)
    estimate = instrumental_variables(rows.system, Z, joint_weights_of(observed, x))
    fixed, full = solve_with_load_friction(observed.with_motors(()))
    ls = solve_least_squares(fixed, full, essential=essential)
    predicted, lags = observed.predicted(estimate), lags_of_ls(observed, estimate)
    without = "with these" if _default_method(observed)[0] == "iv" else "without a recorded reference"
    found = add_lag_variance(estimate, intervals_of(rows.system, estimate), lags)
    found = add_scale_variance(observed, estimate, found)
    evidence = FitData(
        recordings=observed.observations,
        observed=rows,
        method="iv",
        fixed_point=settled,
        estimate=estimate,
        predicted=predicted,
        intervals=found,
        least_squares=ls.full,
        Z=Z,
        unconfirmed=f"drive gains by the measured motion: no robot is simulated {without}",
        lags=lags,
        essential=essential_names(ls.essential, estimate, found),
    )
    fit = fit_of(observed, evidence, replace(ls, estimate=estimate, intervals=found, tau_predicted=predicted))
    return replace(fit, least_squares=ls.of_base())


def solve_least_squares(observed: StackedSystem, full: Estimate, *, essential: bool) -> LeastSquares:
    """Least squares from the estimate `full` of all parameters: its reduction, intervals and torque."""
    rows, predicted = observed.regression, observed.predicted(full)
    rho = (rows.tau - predicted) * full.weights * rows.counts
    reduction = essential_parameters(rows.system, full, correlation=autocorrelation(rho) or 0.0)
    estimate = full
    if essential:
        estimate = reduction.estimate
        predicted = observed.predicted(estimate)
    return LeastSquares(
        estimate=estimate,
        intervals=intervals_of(rows.system, estimate),
        full=full,
        essential=reduction,
        tau_predicted=predicted,
    )


@one_thread
def validate_all(
    recordings: Sequence[tuple[Signals, Overrides]], stored: FitFile, place: str
) -> tuple[tuple[Validated, ...], tuple[TorqueError, ...]]:
    """Torque errors of a stored fit on recordings of one robot, each with its settings; nothing is fitted.

    Parameters
    ----------
    recordings : each with what replaces its settings.
    stored : the fit, with what it found of payloads; `place` names it in errors.

    Returns
    -------
    Each recording with its errors, and the errors of all together: one per joint and, last, that of all joints.
    """
    check_one_robot([signals for signals, _ in recordings])
    names = tuple(j.name for j in recordings[0][0].robot.joints)
    each, parts = [], []
    for signals, overrides in recordings:
        problem = make_problem(signals, overrides)
        beta = stored_beta(stored, problem.base, place) + payload_beta(stored, problem)
        parts.append(torque_of_recording(problem, beta))
        each.append(Validated(signals, problem.settings, torque_errors(*parts[-1], names), *parts[-1][:2]))
    tau, predicted, speed = (np.concatenate(x) for x in zip(*parts, strict=True))
    return tuple(each), torque_errors(tau, predicted, speed, names)
