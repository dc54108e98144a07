"""Least squares of friction terms that may be unidentifiable, or depend on the link torque.

A term whose column is nearly a sum of others is left out, with a message; so is load friction whose
interval contains 0, before the first step. Load friction depends on the link torque
(`regression.load`): steps about the estimate end when no parameter changes by more than a
thousandth of its deviation.

The ramps of the weights of samples are chosen once for a fit, by the half-widths of its method:
long ones keep noise above the low-pass out of the rows, short ones leave more of short moves. Least
squares has its own half-widths; those of instrumental variables come from instruments along the
reference, which need no simulation.
"""

from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Literal

import numpy as np

from ..arrays import Array
from ..errors import NoFitError
from ..estimation import (
    Estimate,
    System,
    instrumental_variables,
    intervals_of,
    r_factor,
    weighted_least_squares,
)
from ..model import SHAPES
from ..regression import RAMPS, ROWS, Problem, Rows, sample_weights
from .equations import Equations, robots_in, simulate_all
from .observation import solver_of

# share of the norm of an identifiable column that is independent of the others
MIN_INDEPENDENT_NORM = 0.01
# of load friction: deviations at the end; shares of a step
MAX_STEPS, MAX_STEP, MIN_STEP = 30, 1e-3, 0.1
# of the largest value: smaller changes are rounding, also where exact data have no deviation
MIN_CHANGE = 1e-10
LONG, SHORT, *OTHERS = RAMPS


def least_squares(
    equations: Equations, method: Literal["ols", "wls"] = "wls"
) -> tuple[Equations, Estimate]:
    """Least squares with the identifiable terms. Raises `NoFitError` as the estimators."""
    equations, solve = leave_out_collinear_terms(equations), solver_of(method)
    if equations.load is None:
        system = equations.about().system
        return equations, equations.combined(system, solve(system))
    others = np.setdiff1d(np.arange(len(equations.names)), equations.load_places())
    x = solve(equations.about().system.with_columns(others)).values_of(equations.names)
    equations, x = leave_out_load(equations, x, solve)
    return equations, settle(
        equations, x, lambda now: equations.combined(now.system, solve(now.system))
    )[1]


def leave_out_load(
    equations: Equations, x: Array, solve: Callable[[System], Estimate]
) -> tuple[Equations, Array]:
    """The equations without load friction that may be zero about x, the least certain first;
    and x without its places.
    """
    system, left_out = equations.about(x).system, dict[str, str]()
    while names := [
        equations.names[i] for i in equations.load_places() if equations.names[i] not in left_out
    ]:
        kept = system.with_columns(np.flatnonzero([name not in left_out for name in system.names]))
        if worst := most_collinear(equations.problem, kept, names):
            left_out |= worst
            continue
        found = intervals_of(kept, estimate := solve(kept))
        places = [estimate.names.index(name) for name in names]
        value, half = estimate.beta[places], found.half[places]
        least = int(np.argmin(np.abs(value) / np.maximum(half, 1e-300)))
        if abs(value[least]) >= half[least]:
            break
        joint = equations.problem.joint_of(names[least])
        text = f"{names[least]} = {value[least]:.2g} ± {half[least]:.2g} may be zero"
        left_out[names[least]] = f"load friction of joint {joint} left out: {text}"
    stay = [name not in left_out for name in equations.names]
    return (equations.without(left_out), x[stay]) if left_out else (equations, x)


def settle(
    equations: Equations, x: Array, solve: Callable[[Rows], Estimate]
) -> tuple[Rows, Estimate]:
    """Steps x + (Z'J)^-1 Z'r, equation (C), until none is above a thousandth of a deviation, halved
    where the next one would move more torque, by the weights of the step before: those of least
    squares rise as the residual falls.

    `solve` gives the whole step from the rows about x: one is enough without load friction. Returns
    the rows about the last x, and its estimate.
    """
    rows = equations.about(x)
    estimate = solve(rows)
    for _ in range(MAX_STEPS if equations.load else 0):
        step, sigma = estimate.values_of(equations.names) - x, np.zeros(len(x))
        sigma[[equations.names.index(name) for name in estimate.names]] = estimate.sigma
        if (np.abs(step) <= np.maximum(MAX_STEP * sigma, MIN_CHANGE * np.abs(x).max())).all():
            break
        share, before = 1.0, _torque(rows, step, estimate.weights)
        while share > MIN_STEP:
            tried = equations.about(x + share * step)
            found = solve(tried)
            left = found.values_of(equations.names) - x - share * step
            if _torque(tried, left, estimate.weights) <= before:
                break
            share /= 2
        else:  # at an edge of the absolute value, from which every step leads back
            break
        x, rows, estimate = x + share * step, tried, found
    return rows, estimate


def _torque(rows: Rows, step: Array, weights: Array) -> float:
    """|J step| with `weights` (n,): the torque that a step moves."""
    return float(np.linalg.norm(rows.system.weighted(weights)[0] @ step))


def leave_out_collinear_terms(equations: Equations) -> Equations:
    """The system without the friction terms, other than load friction, whose columns are
    nearly a sum of others.
    """
    model, base = equations.problem.model, equations.problem.base
    kinds = {
        name: getattr(model.sources[c], "kind", None)
        for name, c in zip(base.names, base.columns, strict=True)
    }
    shapes = [name for name, kind in kinds.items() if kind in SHAPES and kind != "load"]
    while left_out := most_collinear(equations.problem, equations.about().system, shapes):
        equations = equations.without(left_out)
        shapes = [name for name in shapes if name not in left_out]
    return equations


def most_collinear(problem: Problem, system: System, indices: Collection[str]) -> dict[str, str]:
    """The most collinear of these parameters and a message; {} if none exceeds the limit."""
    shares = independent_norm(system, indices)
    lowest = min(shares, key=lambda name: shares[name], default=None)
    if lowest is None or shares[lowest] >= MIN_INDEPENDENT_NORM:
        return {}
    kind = problem.term_of(lowest).kind
    finding = (
        f"{kind} friction of joint {problem.joint_of(lowest)} left out: {lowest} cannot be "
        "distinguished from the others"
    )
    return {lowest: f"{finding} ({100 * shares[lowest]:.1f} % of its column is independent)"}


def independent_norm(system: System, names: Collection[str]) -> dict[str, float]:
    """By parameter the share of its column's norm that is independent of the other
    columns, in the rows used.
    """
    if not names:
        return {}
    norms = np.linalg.norm(system.W, axis=0)
    seen = norms > 1e-12 * norms.max()
    _, singular, Vt = np.linalg.svd(r_factor(system.W[:, seen] / norms[seen]))
    # Row i of the inverse is normal to all other columns; 1 over its length is
    # the share of column i.
    left = 1.0 / np.linalg.norm(Vt / np.maximum(singular, 1e-12 * singular[0])[:, None], axis=0)
    shares = dict.fromkeys(names, 0.0)
    of_seen = (name for name, s in zip(system.names, seen, strict=True) if s)
    return shares | {
        name: float(share) for name, share in zip(of_seen, left, strict=True) if name in shares
    }


def with_best_ramps(equations: Equations, *, instruments: bool) -> Equations:
    """The recordings with the ramps that give smaller half-widths, in the median of the parameters.

    No weights, but rows in which joints move, are tried where moves are short; abrupt weights where
    no ramps determine the parameters. Unchanged where no sample stands, or the ramps are stated.
    """
    stand = (equations.about().share[equations.about().counts] < 1).any()
    if not stand or equations.overrides.ramp_rows is not None:
        return equations
    tried = {ramp: equations.with_ramps(ramp) for ramp in (LONG, SHORT)}
    longest = [sample_weights(one.with_samples()) for one in tried[LONG].with_sources()]
    if any(min(weights.ramps) < LONG for weights in longest):
        tried[ROWS] = equations.with_ramps(ROWS)
    found: dict[float, dict[str, float]] = {}
    # a joint that the reference holds has no instruments along it
    for by_instruments in (instruments, False):
        if len(found) < len(tried):
            each = {
                ramp: _half_widths(one, instruments=by_instruments) for ramp, one in tried.items()
            }
            found = {ramp: half for ramp, half in each.items() if half}
    best = None
    for ramp, half in found.items():
        if (
            best is None
            or np.median([half[x] / found[best][x] for x in half.keys() & found[best].keys()]) < 1
        ):
            best = ramp
    if best is None:
        others = {ramp: equations.with_ramps(ramp) for ramp in OTHERS}
        tried |= others
        best = next((x for x in OTHERS if _half_widths(others[x], instruments=False)), LONG)
    return tried[best]


def _half_widths(equations: Equations, *, instruments: bool) -> dict[str, float]:
    """Half-widths by parameter, without load friction; {} where parameters are undetermined."""
    with suppress(NoFitError):
        equations = leave_out_collinear_terms(equations)
        system = equations.about().system
        columns = np.setdiff1d(np.arange(len(equations.names)), equations.load_places())
        estimate = weighted_least_squares(system.with_columns(columns))
        if instruments:
            beta = estimate.values_of(system.names)
            z = simulate_all(equations, robots_in(equations, beta), beta)
            rows = equations.along(z)
            system = rows.system
            estimate = instrumental_variables(
                system.with_columns(columns), rows.Z[:, columns], estimate.weights
            )
        half = intervals_of(system.with_columns(columns), estimate).half
        return {name: float(x) for name, x in zip(estimate.names, half, strict=True) if x > 0}
    return {}
