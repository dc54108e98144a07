"""Least squares, equation (B): the start of the iterations, and a method of its own.

    x <- x + (Z'J)⁻¹ Z'r,     Z = J

The instruments of drive gains are the exception: they are the torques that x predicts, equation
(I), because the recorded ones are noisy, and least squares biases drive gains towards zero. Gains
and load-dependent friction take several steps, which end when no parameter changes by more than a
thousandth of its standard error.

A friction term whose column is nearly a sum of others is left out, with a message. So is
load-dependent friction whose interval contains 0, before the first step.

The taper of the sample weights is chosen once for a fit, by the half-widths of its method. A long
taper keeps noise above the low-pass out of the rows; a short one leaves more of short moves. With
noisy positions, half-widths of least squares are a poor guide to those of instrumental variables.
Those are computed with instruments from the reference, which need no simulation.
"""

from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import replace

import numpy as np

from acquisition.errors import COMMAND_LINE, BadInputError, Location, NoFitError

from ..arrays import Array, Ints
from ..estimation import (
    Estimate,
    System,
    autocorrelation,
    essential_parameters,
    instrumental_variables,
    intervals_of,
    ordinary_least_squares,
    r_factor,
    relative_residual,
    weighted_least_squares,
    weights_of,
)
from ..model import SHAPES
from ..regression import RAMPS, ROWS, Problem, Rows, refuse_standing_joints, sample_weights
from ..report import FTest, Method
from .model import Model
from .passes import Pass

# A column is identifiable if at least this share of its norm is independent of the others.
MIN_INDEPENDENT_NORM = 0.01
# Steps at most; largest last step in standard errors; smallest share of a step that is tried.
MAX_STEPS, MAX_STEP, MIN_STEP = 30, 1e-3, 0.1
# Of the largest value: smaller changes are rounding, even where exact data have no standard error.
MIN_CHANGE = 1e-10
MIN_KNOWN_SHARE = 1e-6  # of the norm of Y, outside the span of W and L
LONG, SHORT, *OTHERS = RAMPS


def least_squares(model: Model, rows: Rows, method: Method = "wls") -> tuple[Model, Pass]:
    """Solve by least squares, equation (B), from rows about given drive gains only.

    Parameters
    ----------
    model : recordings and unknowns; terms that cannot be identified are left out.
    rows : [Z J r] of all recordings along the measured motion, about `model.start()`.
    method : `ols` without weights; `wls` and `iv` with rows weighted by joint.

    Returns
    -------
    The model with the remaining terms, and the last step, whose rows are about the values before
    it.

    Raises
    ------
    NoFitError : the recordings excite too little, or have no more rows than parameters.
    BadInputError : the recordings do not determine the scale of drive gains.
    """
    model, rows = leave_out_collinear_terms(model, rows)
    x, arm = rows.x, np.setdiff1d(model.unknowns.arm, model.load)
    if model.unknowns.motors:
        refuse_without_scale(model, rows, arm)
    # First solve for the unknowns that are linear, at the given drive gains: with columns of the
    # gains at this point, least squares could set all of them to 0.
    if len(arm) < len(model.names):
        x = model.x_of(solver_of(method)(rows.of(arm)), x)
        if len(model.load):
            model, x = leave_out_load(model, x, method)
        rows = model.rows(x)
    try:
        return model, settle(model, rows, method)
    except NoFitError as error:
        if not model.unknowns.motors:
            raise
        raise BadInputError(
            "they cannot be separated from the parameters of the arm, because the payload has too "
            f"little effect on the recorded efforts ({error})",
            key="gains",
            advice="Check which recordings have the payload, and its mass",
        ) from error


def at_gains(model: Model, found: Pass) -> Pass:
    """Solve for all other unknowns at the drive gains of a solution; without gains return it."""
    if not model.unknowns.motors:
        return found
    x = model.x_of(found.estimate, found.x)
    rows = model.rows(x)
    system = rows.of(model.unknowns.arm)
    estimate = model.combined(system, weighted_least_squares(system))
    return replace(
        found, x=x, rows=rows, estimate=estimate, intervals=intervals_of(system, estimate)
    )


def solver_of(method: Method) -> Callable[[System], Estimate]:
    """Return the estimator of a method: rows are weighted by joint unless it is `ols`."""
    return ordinary_least_squares if method == "ols" else weighted_least_squares


def step_of(model: Model, rows: Rows, method: Method) -> Estimate:
    """Take one step about the x (p,) of the rows, for all free unknowns.

        x + (Z'J)⁻¹ Z'r(x),     Z = J, or for drive gains the torque that x predicts     (C), (I)

    Returns the estimate after the step, combined with given centres of mass. Raises `NoFitError` as
    the estimators do.
    """
    if model.unknowns.motors:
        rho = rows.system.Y - rows.system.W @ rows.x[: len(rows.system.names)]
        # Weights by the residuals at x: those of a least-squares fit at wrong gains differ.
        found = instrumental_variables(rows.system, rows.Z, weights_of(rows.system, rho))
    else:
        found = solver_of(method)(rows.system)
    return model.combined(rows.system, found)


def settle(model: Model, rows: Rows, method: Method) -> Pass:
    """Take steps of equation (C) until none is above a thousandth of a standard error.

        x <- x + c (Z'J)⁻¹ Z'r(x),     c = 1, 1/2, 1/4, 1/8

    c is halved while the next step would change the torque more than this one. Both changes have
    the weights of the step before, because those of least squares rise as the residual falls.
    Without load-dependent friction and drive gains one step is enough.

    The first values are those of the `rows`. Returns the last step. Raises `NoFitError` as
    `step_of`.
    """
    x, estimate, settled = rows.x, step_of(model, rows, method), True
    for _ in range(MAX_STEPS if len(model.load) or model.unknowns.motors else 0):
        step = model.x_of(estimate, x) - x
        sigma = model.x_of(replace(estimate, beta=estimate.sigma), 0 * x)
        if (np.abs(step) <= np.maximum(MAX_STEP * sigma, MIN_CHANGE * np.abs(x).max())).all():
            break
        share, before = 1.0, _torque(rows, step, estimate.weights)
        while share > MIN_STEP:
            tried = model.rows(x + share * step)
            found = step_of(model, tried, method)
            left = model.x_of(found, x) - x - share * step
            if _torque(tried, left, estimate.weights) <= before:
                break
            share /= 2
        # |tau_links| of (H) has an edge, from which every step leads back.
        else:
            break
        x, rows, estimate = x + share * step, tried, found
    else:
        settled = not model.unknowns.motors
    return Pass(
        x=x,
        rows=rows,
        estimate=estimate,
        intervals=intervals_of(rows.system, estimate),
        parameters_settled=settled,
        lags=model.lags,
    )


def _torque(rows: Rows, step: Array, weights: Array) -> float:
    """Return the weighted norm of J @ step, the torque change caused by a step."""
    W = rows.system.weighted(weights)[0]
    return float(np.linalg.norm(W @ step[: W.shape[1]]))


def solution_of(model: Model, found: Pass, *, essential: bool) -> tuple[Pass, Pass, FTest]:
    """Complete a solution by its torque, and find its essential parameters.

    They are found from the rows before the last step, which is small or, of linear terms, the only
    one. Returns the solution of all parameters; the solution of the `essential` ones with the same
    weights if only these are fitted, else the first one again; and the test.
    """
    rows, full = found.kept, found.estimate
    x = model.x_of(full, found.x)
    predicted = model.predicted(x)
    rho = (rows.tau - predicted) * full.weights * rows.counts
    system = rows.of(np.arange(len(full.names)))
    kept = essential_parameters(system, full, correlation=autocorrelation(rho) or 0.0)
    found = solved = replace(found, tau_predicted=predicted)
    if essential:
        system = system.with_columns(np.flatnonzero(np.isin(full.names, kept.names)))
        estimate = model.combined(system, weighted_least_squares(system, full.weights))
        intervals, predicted = intervals_of(system, estimate), model.predicted(x, estimate)
        solved = replace(found, estimate=estimate, intervals=intervals, tau_predicted=predicted)
    return found, solved, kept


def refuse_without_scale(model: Model, rows: Rows, arm: Ints) -> None:
    """Refuse recordings whose given payloads and torques the robot's parameters could explain.

    Without a torque outside the span of the arm's columns, all parameters and drive gains may be
    scaled by a common factor. `arm` are the places of the arm's parameters in x.
    """
    of, system = model.unknowns, rows.system
    size, typical = np.linalg.norm(system.Y), np.linalg.norm(rows.tau * rows.share)
    left = size * relative_residual(system.W[:, arm], system.Y) if size > 0 else 0.0
    if left > MIN_KNOWN_SHARE * max(float(size), 1e-9 * float(typical)):
        return
    payloads = {one.payload for one in of.payloads}
    several = len(payloads) + any(one.payload is None for one in of.arms) > 1
    COMMAND_LINE.require(
        not several or all(payload.center_of_mass_m is not None for payload in payloads),
        "payload",
        text="drive gains cannot be identified with a payload of unknown mass"
        if any(payload.mass_kg is None for payload in payloads)
        else "drive gains cannot be identified from the mass of the payload alone",
        advice="Give its mass and its center of mass: KG@X,Y,Z",
    )
    Location(", ".join(model.recordings)).refuse(
        "gains",
        text="drive gains cannot be identified, since all recordings have the same payload",
        advice="Use one recording without and one with a payload",
    )


def leave_out_load(model: Model, x: Array, method: Method) -> tuple[Model, Array]:
    """Leave out load-dependent friction that may be zero; return model and x (p,).

    The term with the widest relative interval goes first, and the others are estimated again.
    """
    arm, left_out = model.rows(x).of(model.unknowns.arm), dict[str, str]()
    names = [model.names[i] for i in model.load]
    while names := [name for name in names if name not in left_out]:
        kept = arm.with_columns(np.flatnonzero([name not in left_out for name in arm.names]))
        if worst := most_collinear(model.problem, kept, names):
            left_out |= worst
            continue
        found = intervals_of(kept, estimate := solver_of(method)(kept))
        places = [estimate.names.index(name) for name in names]
        value, half = estimate.beta[places], found.half[places]
        least = int(np.argmin(np.abs(value) / np.maximum(half, 1e-300)))
        if abs(value[least]) >= half[least]:
            break
        name, joint = names[least], model.problem.joint_of(names[least])
        left_out[name] = (
            f"load-dependent friction of joint {joint} is left out: {name} = {value[least]:.2g} ± "
            f"{half[least]:.2g} may be zero"
        )
    return model.without(left_out), x[[name not in left_out for name in model.unknowns.all]]


def leave_out_collinear_terms(model: Model, rows: Rows) -> tuple[Model, Rows]:
    """Leave out friction terms whose columns are nearly a sum of others; return model and rows.

    Load-dependent friction is kept.
    """
    kinds = zip(model.problem.base.names, model.problem.kinds, strict=True)
    shapes = [name for name, kind in kinds if kind in SHAPES and kind != "load"]
    left_out = dict[str, str]()
    refuse_standing_joints(rows.share, [problem.signals for problem in model.problems])
    while shapes and (worst := most_collinear(model.problem, rows.system, shapes)):
        left_out |= worst
        shapes, rows = [name for name in shapes if name not in left_out], rows.without(worst)
    return model.without(left_out), rows


def most_collinear(problem: Problem, system: System, indices: Collection[str]) -> dict[str, str]:
    """Return the most collinear of the named parameters and a message, as {name: message}.

    It has the smallest share of its column's norm that is independent of the other columns, in the
    rows used. The result is empty if that share is large enough.
    """
    norms = np.linalg.norm(system.W, axis=0)
    seen = norms > 1e-12 * norms.max()
    _, singular, Vt = np.linalg.svd(r_factor(system.W[:, seen] / norms[seen]))
    # Row i of the inverse is normal to all other columns, and 1 over its length is the share of
    # column i that is independent of them.
    left = np.zeros(len(norms))
    left[seen] = 1 / np.linalg.norm(Vt / np.maximum(singular, 1e-12 * singular[0])[:, None], axis=0)
    shares = {name: float(left[system.names.index(name)]) for name in indices}
    lowest = min(shares, key=shares.__getitem__)
    if shares[lowest] >= MIN_INDEPENDENT_NORM:
        return {}
    return {
        lowest: f"{problem.term_of(lowest).kind} friction of joint {problem.joint_of(lowest)} is "
        f"left out: {lowest} cannot be distinguished from the other parameters "
        f"({100 * shares[lowest]:.1f} % of its column is independent)"
    }


def with_best_ramps(model: Model, *, instruments: bool) -> tuple[Model, Rows]:
    """Choose the weight taper with the smaller half-widths, by the median ratio of all parameters.

    If moves are short, rows in motion without weights are tried too. If the parameters cannot be
    determined with any taper, abrupt weights are used. Nothing changes if no sample is at rest, or
    the taper is given.

    Parameters
    ----------
    model : recordings and unknowns.
    instruments : True to compare half-widths of instruments from the reference, False to compare
        those of least squares.

    Returns
    -------
    The model with this taper, and its rows about the start.
    """
    x = model.start()
    longest = [sample_weights(one.problem.with_samples()) for one in model.equations]
    stand = any(((w.of_rows > 0) & (w.of_rows < 1)).any() for w in longest)
    if model.overrides.ramp_rows is not None or not stand:
        return model, model.rows(x)
    short = any(min(weights.ramps) < LONG for weights in longest)
    robots = model.robots(x) if instruments else ()

    def at(ramp: float) -> tuple[Model, Rows]:
        one = replace(
            model,
            overrides=replace(model.overrides, ramp_rows=ramp),
            problems=tuple(
                replace(one, settings=replace(one.settings, ramp_rows=ramp))
                for one in model.problems
            ),
        )
        # What cannot be simulated is refused after least squares, with a better reason.
        with suppress(BadInputError):
            return one, one.with_instruments(robots, x, None)[1] if instruments else one.rows(x)
        return one, one.rows(x)

    tried = {ramp: at(ramp) for ramp in (LONG, SHORT, *[ROWS] * short)}
    half = dict[float, dict[str, float]]()
    # Instruments from the reference do not excite a joint that the reference holds: then all are
    # compared by least squares.
    for along in (instruments, False):
        if len(half) < len(tried):
            half = {
                ramp: found
                for ramp, one in tried.items()
                if (found := _half_widths(*one, along=along))
            }
    if not half:
        others = (one for ramp in OTHERS if _half_widths(*(one := at(ramp)), along=False))
        return next(others, tried[LONG])
    best = next(iter(half))
    for ramp, of in half.items():
        if np.median([of[x] / half[best][x] for x in of.keys() & half[best].keys()]) < 1:
            best = ramp
    return tried[best]


def _half_widths(model: Model, rows: Rows, *, along: bool) -> dict[str, float]:
    """Return the half-widths by parameter, without load-dependent friction.

    They are those of instruments if the rows are `along` another motion, else those of least
    squares. The result is empty if parameters are undetermined.
    """
    with suppress(NoFitError):
        model, rows = leave_out_collinear_terms(model, rows)
        places = np.setdiff1d(model.unknowns.arm, model.load)
        system = rows.of(places)
        estimate = weighted_least_squares(system)
        if along and rows.Z.size:
            estimate = instrumental_variables(system, rows.Z[:, places], estimate.weights)
        half = intervals_of(system, estimate).half
        return {name: x for name, x in zip(estimate.names, half.tolist(), strict=True) if x > 0}
    return {}
