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
from ..regression import Overrides, Rows, Term, base_places
from ..report import Method
from ..simulation import Simulated
from ..trust import covariance_of_all
from . import iteration as iv
from .assess import assess_iv, candidates_of, evidence_of, fit_of
from .equations import Equations, read_equations, robots_in, simulate_all
from .fit import Fit, LeastSquares, Pass, join_reasons
from .gains import factors_of, joint_weights_of, measured_instruments, motors_of, solve_with_gains
from .iteration import Iteration, NoEstimateError
from .observation import position_noise_line, solver_of
from .settled import least_squares, settle, with_best_ramps
from .timing import correct_known_lags, with_lags, with_lags_found

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
    x, each = full.values_of(equations.names), list[Rows]()
    if equations.reduced:
        each = equations.rows_about(x, candidates_of(equations, x))
    rows = equations.stacked(each) if each else equations.about(x)
    if each or equations.load:  # of these very rows
        full = equations.combined(rows.system, solver_of(method)(rows.system))
    ls = solve_least_squares(equations, full, rows, essential=essential)
    evidence = evidence_of(equations, method, ls, rows, each=each)
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
    """IDIM-IV; long recordings start where their beginnings end, with the lags of these."""
    motors, begun = motors_of(equations), equations.beginning()
    if motors:
        begun, x, settled = solve_with_gains(begun)
        if not settled or _default_method(begun)[0] != "iv" or not (factors_of(begun, x) > 0).all():
            if equations.reduced:  # the fit would be that of the beginning alone
                raise BadInputError(
                    "the recordings are too long to identify gains without a simulated robot",
                    key="gains",
                    expected="a recorded reference, a larger decimation or shorter recordings",
                )
            return _by_measured_motion(begun, x, settled=settled, essential=essential)
        begun = begun.with_gains(factors_of(begun, x)).with_motors(())
        iteration = replace(iteration, start="ls") if iteration.values is None else iteration
    begun, ls, passes, best = _solve_by_instruments(begun, iteration, essential=essential, say=say)
    if equations.reduced:
        equations = equations.without(begun.left_out) if begun.left_out else equations
        equations = (
            equations.with_gains(np.asarray(begun.problem.gains)).with_motors(())
            if motors
            else equations
        )
        start = begun.names, best.estimate.values_of(begun.names), best.covariance
        begun = with_lags(equations, begun.lags)
        del equations, ls, passes, best  # with their rows
        begun, ls, passes, best = _solve_by_instruments(
            begun, iteration, essential=essential, say=say, start=start
        )
    return assess_iv(begun, best, ls, passes, iteration.start)


def _solve_by_instruments(
    equations: Equations,
    iteration: Iteration,
    *,
    essential: bool,
    say: Say,
    start: tuple[tuple[str, ...], Array, Array] | None = None,
) -> tuple[Equations, LeastSquares, list[Pass], Pass]:
    """The instruments Z are the regressor of the robot simulated with the previous estimate.

    W and Y are those of IDIM-LS. Each pass simulates the closed loop with beta_k (same reference,
    same controller, gains updated by beta_k), evaluates Z = IDM of the simulated q, dq, ddq,
    decimated as W, finds the lag L of the torque by the same instruments, and solves for beta_k+1.
    `start`: names, values and covariance in place of those of `iteration`.
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
    if start is not None:  # the whole may leave out terms that its beginning has
        at = [start[0].index(name) for name in names]
        x, C, robot = start[1][at], start[2][np.ix_(at, at)], None
    every = np.arange(len(names))
    fitted = (
        np.union1d(ls.essential.kept, np.delete(every, base_places(names))) if essential else every
    )
    robots = robots_in(equations, prior, gain_update=iteration.gain_update)

    def step(rows: Rows, Z: Array) -> Estimate:  # beta = (ZᵀW)⁻¹ ZᵀY
        system = rows.system.with_columns(fitted)
        return equations.combined(system, instrumental_variables(system, Z[:, fitted], weights))

    def one_pass(equations: Equations, x: Array, z: tuple[Simulated, ...]) -> Pass:
        W_and_Y = equations.along(x, z)
        try:
            estimate = step(W_and_Y, W_and_Y.Z)
        except NoFitError as error:
            reasons = [(one.recording, one.reason) for one in z]
            raise NoEstimateError(join_reasons(reasons)) from error
        # C = D R D
        after = covariance_of_all(names, estimate, intervals_of(W_and_Y.system, estimate), ls.full)
        return iv.assess_pass(
            x,
            z,
            estimate,
            W_and_Y.system,
            (C, after),
            tolerance_percent=tolerance_percent,
        )

    def next_pass(equations: Equations, number: int) -> tuple[Equations, Pass]:
        coarse = regular and iv.is_coarse(equations.problem, number, most)
        # Z = IDM(q_sim, dq_sim, ddq_sim); a first pass of a long recording only
        # starts the next ones
        further = terms_of_long(equations, x) if number > 1 or most == 1 else ()
        asked = x if robot is None else robot, C
        z = simulate_all(equations, robots, x, asked, coarse=coarse, further=further)
        if not coarse and robot is None:  # Y(tau(t + L))
            equations = with_lags_found(equations, x, z, weights)
        found = one_pass(equations, x, z)
        return equations, replace(found, number=number, coarse=coarse, robot=robot)

    given, first = equations, x
    ls, passes, regular = ls.without_rows(), list[Pass](), C is None
    stored = equations.problem.signals.robot.identification
    most = iteration.max_iterations or stored.max_iterations
    tolerance_percent = iteration.tolerance_percent or stored.tolerance_percent
    while (
        not (passes and passes[-1].is_last and len(passes) > equations.reduced)
        and len(passes) < most
    ):
        say(f"pass {len(passes) + 1}: simulating the robot")
        passes = [one.without_rows() for one in passes]
        try:
            equations, last = next_pass(equations, len(passes) + 1)
        except NoEstimateError as error:
            passes = iv.failed(passes, error, [one.signals.recording for one in equations.problems])
            break
        passes, C = [*passes, last], last.covariance
        x, robot = iv.next_values(passes, names), None
    further = partial(terms_of_long, equations)
    best = iv.conclude(
        equations,
        robots,
        passes,
        further,
        lambda x, z: step(rows := equations.along(x, z), rows.Z),
    )
    if why := iv.why_by_reference(equations, passes, best):
        z = simulate_all(given, robots, first, coarse=True, further=terms_of_long(given, first))
        found = with_lags_found(given, first, z, weights)
        with suppress(NoEstimateError):
            last = one_pass(found, first, z)
            last = replace(last, number=len(passes) + 1, by_reference=why, confirmed_by=z)
            if iv.why_by_reference(found, [last], last) is None:
                equations, passes, best = found, [*passes, last], last
    passes = [one.without_rows() for one in passes]
    if motors:
        equations = equations.with_gains(factors_of(equations, best.estimate.values_of(names)))
    if motors or equations.load:
        x = best.estimate.values_of(names)
        x[equations.unknowns.gains] = 1.0
        rows = equations.along(best.x, best.z)
        estimate = (
            step(rows, rows.Z)
            if equations.reduced
            else settle(equations, x, partial(step, Z=rows.Z))[1]
        )
        best = replace(best, estimate=estimate, x=x)
    return equations, ls, passes, best


def _by_measured_motion(equations: Equations, x: Array, *, settled: bool, essential: bool) -> Fit:
    """Drive gains and parameters by the fixed point of `solve_with_gains`, where no
    robot can be simulated.
    """
    equations = equations.with_gains(factors_of(equations, x))
    x[equations.unknowns.gains] = 1.0
    rows, Z = equations.about(x), measured_instruments(equations, x)
    estimate = instrumental_variables(rows.system, Z, joint_weights_of(rows.system, x))
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
        evidence_of(equations, "iv", solved, replace(rows, Z=Z)),
        fixed_point=settled,
        unconfirmed=f"drive gains by the measured motion: no robot is simulated {without}",
    )
    solved = replace(solved, intervals=evidence.intervals)
    return replace(fit_of(equations, evidence, solved), least_squares=ls.of_base())


def terms_of_long(equations: Equations, x: Array) -> tuple[Term, ...]:
    """What the rows of long recordings have beside the equations about x; nothing
    for rows that are held.
    """
    return candidates_of(equations, x, simulated=True) if equations.reduced else ()


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
