"""Identification by the inverse dynamic model, with least squares or instrumental variables.

Letters and equation numbers are those of Janot2014: A. Janot, P.-O. Vandanjon, M. Gautier, "An
instrumental variable approach for rigid industrial robots identification", Control Engineering
Practice 25 (2014) 85-101.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from .. import estimation
from ..arrays import Array
from ..data import Recordings, Signals
from ..errors import BadInputError, NoFitError
from ..estimation import Estimate, autocorrelation, instrumental_variables, intervals_of, one_thread
from ..regression import Overrides, Rows, base_places
from ..report import Method
from ..simulation import Simulated
from ..trust import covariance_of_all
from . import iteration as iv
from .assess import assess_iv, candidates_of, evidence_of, fit_of
from .equations import Equations, read_equations, robots_in, simulate_all
from .fit import Fit, LeastSquares, Pass, join_reasons
from .gains import factors_of, joint_weights_of, measured_rows, motors_of, solve_with_gains
from .iteration import Iteration, NoEstimateError
from .observation import position_noise_line, solver_of
from .settled import least_squares, with_best_ramps
from .timing import correct_known_lags, with_lags_found

Say = Callable[[str], None]


@one_thread
def identify(
    signals: Signals | Recordings,
    overrides: Overrides,
    *,
    method: Method | None = None,
    iteration: Iteration | None = None,
    essential: bool = False,
    say: Say = lambda text: None,
) -> Fit:
    """Base parameters beta from measured torque and position.

    Parameters
    ----------
    signals : the recording, or several of one robot; each is filtered and decimated separately.
    overrides : settings that replace those of the description; `Overrides()` for none.
    method : `iv`, instrumental variables; `wls`, least squares with rows weighted by joint; `ols`,
        without weights. Default: `iv` if every recording has its reference, else `wls`.
    iteration : of `iv`: start of the passes, and when they end.
    essential : fit only the essential parameters.
    say : called with a line of text for each step.

    Returns
    -------
    The estimate with its tests. The status of least squares is `solved`; that of `iv` is
    `converged` only if two passes agree and the robot simulated with the estimate
    follows the recording.

    Raises
    ------
    NoFitError : a recording is too short, the recordings excite too little, or the first
        pass gives no estimate.
    BadInputError : the recordings are not of one robot, or an `iteration` is
        given to least squares.
    """
    # (2): tau = IDM(q, dq, ddq) beta; (5), (6): Y(tau) = W(q, dq, ddq) beta + rho
    asked = replace(overrides, method="iv" if overrides.gains else method)
    equations = read_equations(signals, asked, say)
    chosen, reason = (method, "as requested") if method is not None else _default_method(equations)
    settings = [problem.settings for problem in equations.problems]
    low = settings[0].low_speed.iv if "iv" in (asked.method, chosen) else settings[0].low_speed.ls
    # not every recording has its reference
    if any(one.low_speed_percent != low for one in settings):
        equations = read_equations(signals, replace(asked, method=chosen), say)
    equations = correct_known_lags(equations)
    if equations.overrides.gains and chosen != "iv" and method is not None:
        raise BadInputError(
            "least squares is biased towards drive gains of 0",
            key="method",
            value=chosen,
            expected="iv with --gains",
        )
    equations = with_best_ramps(equations, instruments=chosen == "iv" or bool(overrides.gains))
    if chosen == "iv" or equations.overrides.gains:
        try:
            fit = _by_instruments(equations, iteration or Iteration(), essential=essential, say=say)
        except NoFitError as error:
            if method is None and not motors_of(equations):
                error.args = (f"{error.args[0]}; least squares: --method wls",)
            raise
    else:
        if iteration is not None:
            raise BadInputError(
                "only instrumental variables iterate",
                key="method",
                value=chosen,
                expected=f"iv ({reason})",
            )
        fit = _by_least_squares(equations, chosen, essential=essential)
    return replace(fit, method_reason=reason)


def _default_method(equations: Equations) -> tuple[Literal["iv", "wls"], str]:
    """The default method and its reason: instruments if every recording has its reference."""
    without = [problem.signals for problem in equations.problems if problem.signals.q_ref is None]
    if not without:
        return "iv", "reference recorded"
    where = f" in {without[0].recording}" if len(equations.problems) > 1 else ""
    return "wls", f"no reference{where}"


def identify_ls(
    signals: Signals | Recordings,
    overrides: Overrides,
    *,
    method: Literal["ols", "wls"] = "wls",
    essential: bool = False,
    say: Say = lambda text: None,
) -> Fit:
    """IDIM-LS, section 2; parameters as of `identify`."""
    return identify(signals, overrides, method=method, essential=essential, say=say)


def identify_iv(
    signals: Signals | Recordings,
    overrides: Overrides,
    iteration: Iteration,
    *,
    essential: bool = False,
    say: Say = lambda text: None,
) -> Fit:
    """IDIM-IV, section 3; parameters as of `identify`."""
    return identify(
        signals, overrides, method="iv", iteration=iteration, essential=essential, say=say
    )


def _by_least_squares(
    equations: Equations, method: Literal["ols", "wls"], *, essential: bool
) -> Fit:
    """IDIM-LS: W and Y from the measured torque and the filtered position."""
    equations, full = least_squares(equations, method)
    x = full.values_of(equations.names)
    each = equations.rows_about(x, candidates_of(equations, x))
    rows = equations.stacked(each)
    # of these very rows
    full = equations.combined(rows.system, solver_of(method)(rows.system))
    ls = solve_least_squares(equations, full, rows, essential=essential)
    evidence = evidence_of(equations, method, ls, each)
    ls = replace(ls, intervals=evidence.intervals)
    # Once, of the first recording: it looks at the beginning of a long one anyway.
    first, alone = (
        equations.tasks()[0].with_samples(),
        equations.unknowns.plain and not equations.load,
    )
    noise = position_noise_line(first, method, ls, alone=alone)
    return fit_of(equations, replace(evidence, position_noise=noise), ls)


def _by_instruments(
    equations: Equations, iteration: Iteration, *, essential: bool, say: Say
) -> Fit:
    """IDIM-IV; drive gains start at the fixed point with the measured motion."""
    if motors_of(equations):
        equations, x, settled = solve_with_gains(equations)
        factors = factors_of(equations, x)
        if not settled or _default_method(equations)[0] != "iv" or not (factors > 0).all():
            return _by_measured_motion(equations, x, settled=settled, essential=essential)
        equations = equations.with_gains(factors).with_motors(())
        iteration = replace(iteration, start="ls") if iteration.values is None else iteration
    found = _solve_by_instruments(equations, iteration, essential=essential, say=say)
    return assess_iv(*found, iteration.start)


def _solve_by_instruments(
    equations: Equations, iteration: Iteration, *, essential: bool, say: Say
) -> tuple[Equations, Pass, LeastSquares, list[Pass]]:
    """The instruments Z are the regressor of the robot simulated with the previous estimate.

    W and Y are those of IDIM-LS. Each pass simulates the closed loop with beta_k (same reference,
    same controller, gains updated by beta_k), evaluates Z = IDM of the simulated q, dq, ddq,
    decimated as W, finds the lag L of the torque by the same instruments, and solves for beta_k+1.
    """
    equations, full = least_squares(equations)
    ls = solve_least_squares(
        equations, full, equations.about(full.values_of(equations.names)), essential=essential
    )
    prior = iv.inertia_prior(equations, ls)
    x, C, robot = iv.start_values(equations, iteration, ls)
    if motors := motors_of(equations):
        equations, ones = equations.with_motors(motors), np.ones(len(motors))
        x, prior, C = (
            np.r_[x, ones],
            np.r_[prior, ones],
            None if C is None else np.pad(C, (0, len(motors))),
        )
    names, weights = equations.names, full.weights
    every = np.arange(len(names))
    fitted = (
        np.union1d(ls.essential.kept, np.delete(every, base_places(names))) if essential else every
    )
    robots = robots_in(equations, prior, gain_update=iteration.gain_update)

    def step(rows: Rows) -> Estimate:  # beta = (ZᵀW)⁻¹ ZᵀY
        system = rows.system.with_columns(fitted)
        return equations.combined(
            system, instrumental_variables(system, rows.Z[:, fitted], weights)
        )

    def one_pass(equations: Equations, x: Array, z: tuple[Simulated, ...]) -> Pass:
        W_and_Y = equations.along(z)
        try:
            estimate = step(W_and_Y)
        except NoFitError as error:
            reasons = [(one.recording, one.reason) for one in z]
            raise NoEstimateError(join_reasons(reasons)) from error
        # C = D R D
        after = covariance_of_all(names, estimate, intervals_of(W_and_Y.system, estimate), ls.full)
        return iv.assess_pass(
            x, z, estimate, W_and_Y.system, (C, after), tolerance_percent=tolerance_percent
        )

    def next_pass(equations: Equations) -> tuple[Equations, Pass]:
        # Z = IDM(q_sim, dq_sim, ddq_sim)
        asked, further = (x if robot is None else robot, C), terms(equations, x)
        left = solved if robot is None else None
        z = simulate_all(equations, robots, x, asked, further=further, before=left)
        equations, settled = with_lags_found(equations, z, first=not passes)  # Y(tau(t + L))
        return equations, replace(one_pass(equations, x, z), robot=robot, lags_settled=settled)

    first, solved, terms = x, x, partial(candidates_of, simulated=True)
    ls, passes = ls.without_rows(), list[Pass]()
    stored = equations.problem.signals.robot.identification
    most = iteration.max_iterations or stored.max_iterations
    tolerance_percent = iteration.tolerance_percent or stored.tolerance_percent
    while not (passes and passes[-1].is_last) and len(passes) < most:
        say(f"pass {len(passes) + 1}: simulating the robot")
        passes = [one.without_rows() for one in passes]
        try:
            equations, last = next_pass(equations)
        except NoEstimateError as error:
            passes = iv.failed(passes, error, [one.signals.recording for one in equations.problems])
            break
        passes, C = [*passes, replace(last, number=len(passes) + 1)], last.covariance
        solved, x, robot = last.estimate.values_of(names), iv.next_values(passes, names), None
    best = iv.conclude(
        equations, robots, passes, partial(terms, equations), lambda z: step(equations.along(z))
    )
    if why := iv.why_by_reference(equations, passes, best):
        further = terms(equations, first)
        z = simulate_all(equations, robots, first, further=further, before=solved)
        found, _ = with_lags_found(equations, z, first=False)
        with suppress(NoEstimateError):
            last = one_pass(found, first, z)
            last = replace(last, number=len(passes) + 1, by_reference=why, confirmed_by=z)
            if iv.why_by_reference(found, [last], last) is None:
                equations, passes, best = found, [*passes, last], last
    passes = [one.without_rows() for one in passes]
    if motors:
        equations = equations.with_gains(factors_of(equations, best.estimate.values_of(names)))
        best = replace(best, estimate=step(equations.along(best.z)))
    return equations, best, ls, passes


def _by_measured_motion(equations: Equations, x: Array, *, settled: bool, essential: bool) -> Fit:
    """Drive gains and parameters by the fixed point of `solve_with_gains`, where no
    robot can be simulated.
    """
    equations = equations.with_gains(factors_of(equations, x))
    x[equations.unknowns.gains] = 1.0
    each = measured_rows(equations, x, candidates_of(equations, x))
    rows = equations.stacked(each)
    estimate = instrumental_variables(rows.system, rows.Z, joint_weights_of(rows.system, x))
    estimate = equations.combined(rows.system, estimate)
    fixed, full = least_squares(equations.with_motors(()))
    ls = solve_least_squares(
        fixed, full, fixed.about(full.values_of(fixed.names)), essential=essential
    )
    without = (
        "with these" if _default_method(equations)[0] == "iv" else "without a recorded reference"
    )
    solved = replace(ls, estimate=estimate, tau_predicted=equations.predicted(estimate))
    evidence = replace(
        evidence_of(equations, "iv", solved, each),
        fixed_point=settled,
        unconfirmed=f"drive gains by the measured motion: no robot is simulated {without}",
    )
    solved = replace(solved, intervals=evidence.intervals)
    return replace(fit_of(equations, evidence, solved), least_squares=ls.of_base())


def solve_least_squares(
    equations: Equations, full: Estimate, rows: Rows, *, essential: bool
) -> LeastSquares:
    """Least squares from the estimate `full` of all parameters, and its rows: its
    reduction, intervals and torque.
    """
    predicted = equations.predicted(full)
    rho = (rows.tau - predicted) * full.weights * rows.counts
    reduction = estimation.essential_parameters(
        rows.system, full, correlation=autocorrelation(rho) or 0.0
    )
    estimate = full
    if essential:
        estimate = equations.combined(rows.system.with_columns(reduction.kept), reduction.estimate)
        predicted = equations.predicted(estimate)
    return LeastSquares(
        estimate=estimate,
        intervals=intervals_of(rows.system, estimate),
        full=full,
        essential=reduction,
        tau_predicted=predicted,
    )
