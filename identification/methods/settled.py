"""Least squares of friction terms that may be unidentifiable or depend on the previous estimate.

A term whose column is nearly a sum of others is left out, with a message. Load friction depends on the link torque of the
previous pass (`regression.load`): passes end when every parameter changes by less than half a deviation. The load friction
of a joint that does not converge is left out, with a message.

The ramps of the weights of samples are chosen once for a fit, by the half-widths of its method: long ones keep noise above the
low-pass out of the rows, short ones leave more of short moves. Least squares has its own half-widths; those of instrumental
variables come from instruments along the reference, which need no simulation.
"""

from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Literal

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import (
    Estimate,
    System,
    condensed,
    instrumental_variables,
    intervals_of,
    one_thread,
    weighted_least_squares,
)
from ..model import SHAPES, JointTerm
from ..regression import RAMPS, ROWS, LoadFriction, Problem, Regression, sample_weights
from .observation import solver_of
from .system import StackedSystem

MIN_INDEPENDENT_NORM = 0.01  # share of the norm of an identifiable column that is independent of the others
MAX_PASSES = 10
MIN_CHANGE = 1e-10  # of the largest value: smaller changes are rounding, also where exact data have no deviation
LONG, SHORT, *OTHERS = RAMPS


def solve_with_load_friction(
    observed: StackedSystem, method: Literal["ols", "wls"] = "wls"
) -> tuple[StackedSystem, Estimate]:
    """Least squares with the identifiable terms, and the system about the solution.

    Raises `IdentificationError` as the estimators.
    """
    solve = solver_of(method)
    observed = leave_out_collinear_terms(observed)
    while observed.load:
        names, places = observed.parameters.names, observed.load_places()
        others = np.setdiff1d(np.arange(len(names)), places)
        about = solve(condensed(observed.regression.system.with_columns(others))).values_of(names)
        left_out = most_collinear(observed.problem, observed.at(about).regression.system, [names[i] for i in places])
        if not left_out:
            settled, _, left_out = load_passes(observed, lambda x: solve(condensed(x.system)), about, observed.load)
        if not left_out:
            return settled, solve(settled.regression.system)
        observed = observed.without(left_out)
    return observed, solve(observed.regression.system)


def load_passes(
    observed: StackedSystem, solve: Callable[[Regression], Estimate], beta: Array, load: LoadFriction | None
) -> tuple[StackedSystem, Estimate, dict[str, str]]:
    """Solve in passes from the parameters `beta` (b,) on, until they settle, at most ten times.

    `solve` estimates some or all parameters from W and Y about the previous ones, with the load friction of `load`.

    Returns
    -------
    The system of the last pass, and its estimate. If a parameter still changed by over half a deviation: the parameters of load
    friction that did, or the one that changed most, each with a message; else {}.
    """
    if load is None:
        return observed, solve(observed.regression), {}
    names, values = observed.parameters.names, list[Array]()
    places, robot = observed.load_places(load), observed.problem.signals.robot
    for _ in range(MAX_PASSES):
        about, observed = beta, observed.at(beta, load)
        estimate = solve(observed.regression)
        beta, sigma = estimate.values_of(names), np.zeros(len(names))
        sigma[[names.index(name) for name in estimate.names]] = estimate.sigma
        off = np.abs(beta - about) / np.maximum(sigma / 2, MIN_CHANGE * np.abs(beta).max())
        values.append(beta)
        if (off < 1).all():
            return observed, estimate, {}
    unsettled, own = {}, off[places]
    for j, place, far in zip(load.joints, places, own, strict=True):
        if far >= 1 or far == own.max():
            mu, joint = names[place], robot.joints[j].name
            last = ", ".join(f"{value[place]:.3g}" for value in values[-3:])
            unsettled[mu] = f"load friction of joint {joint} left out: it does not converge ({mu} {last})"
    return observed, estimate, unsettled


def leave_out_collinear_terms(observed: StackedSystem) -> StackedSystem:
    """The system without the friction terms, other than load friction, whose columns are nearly a sum of others."""
    model, base = observed.problem.model, observed.problem.base
    kinds = {name: getattr(model.sources[c], "kind", None) for name, c in zip(base.names, base.columns, strict=True)}
    shapes = [name for name, kind in kinds.items() if kind in SHAPES and kind != "load"]
    while left_out := most_collinear(observed.problem, observed.regression.system, shapes):
        observed = observed.without(left_out)
        shapes = [name for name in shapes if name not in left_out]
    return observed


def most_collinear(problem: Problem, system: System, indices: Collection[str]) -> dict[str, str]:
    """The most collinear of these parameters and a message; {} if none exceeds the limit."""
    shares = independent_norm(system, indices)
    lowest = min(shares, key=lambda name: shares[name], default=None)
    if lowest is None or shares[lowest] >= MIN_INDEPENDENT_NORM:
        return {}
    source = problem.model.sources[problem.base.columns[problem.base.names.index(lowest)]]
    assert isinstance(source, JointTerm)
    joint = problem.signals.robot.joints[int(source.rows[-1])].name
    finding = f"{source.kind} friction of joint {joint} left out: {lowest} cannot be distinguished from the others"
    return {lowest: f"{finding} ({100 * shares[lowest]:.1f} % of its column is independent)"}


def independent_norm(system: System, names: Collection[str]) -> dict[str, float]:
    """By parameter the share of its column's norm that is independent of the other columns, in the rows used."""
    if not names:
        return {}
    system = condensed(system)
    norms = np.linalg.norm(system.W, axis=0)
    seen = norms > 1e-12 * norms.max()
    _, singular, Vt = np.linalg.svd(np.linalg.qr(system.W[:, seen] / norms[seen], mode="r"))
    # Row i of the inverse is normal to all other columns; 1 over its length is the share of column i.
    left = 1.0 / np.linalg.norm(Vt / np.maximum(singular, 1e-12 * singular[0])[:, None], axis=0)
    shares = dict.fromkeys(names, 0.0)
    of_seen = (name for name, s in zip(system.names, seen, strict=True) if s)
    return shares | {name: float(share) for name, share in zip(of_seen, left, strict=True) if name in shares}


@one_thread
def with_best_ramps(observed: StackedSystem, *, instruments: bool) -> StackedSystem:
    """The recordings with the ramps that give smaller half-widths, in the median of the parameters.

    No weights, but rows in which joints move, are tried where moves are short; abrupt weights where no ramps determine the
    parameters. Unchanged where no sample stands, or the ramps are stated.
    """
    stand = (observed.regression.share[observed.regression.counts] < 1).any()
    if not stand or observed.overrides.ramp_rows is not None:
        return observed
    span = observed.on_span()
    tried = {ramp: span.with_ramps(ramp) for ramp in (LONG, SHORT)}
    if any(min(sample_weights(one.problem.with_samples()).ramps) < LONG for one in tried[LONG].observations):
        tried[ROWS] = span.with_ramps(ROWS)
    found: dict[float, dict[str, float]] = {}
    for by_instruments in (instruments, False):  # a joint that the reference holds has no instruments along it
        if len(found) < len(tried):
            each = {ramp: _half_widths(one, instruments=by_instruments) for ramp, one in tried.items()}
            found = {ramp: half for ramp, half in each.items() if half}
    best = None
    for ramp, half in found.items():
        if best is None or np.median([half[x] / found[best][x] for x in half.keys() & found[best].keys()]) < 1:
            best = ramp
    if best is None:
        able = (ramp for ramp in OTHERS if _half_widths(span.with_ramps(ramp), instruments=False))
        best = next(able, LONG)
    return tried[best] if span is observed and best in tried else observed.with_ramps(best)


def _half_widths(observed: StackedSystem, *, instruments: bool) -> dict[str, float]:
    """Half-widths by parameter, without load friction; {} where parameters are undetermined."""
    with suppress(IdentificationError):
        observed = leave_out_collinear_terms(observed)
        system, columns = (
            observed.regression.system,
            np.setdiff1d(np.arange(len(observed.parameters.names)), observed.load_places()),
        )
        estimate = weighted_least_squares(system.with_columns(columns))
        if instruments:
            beta = estimate.values_of(system.names)
            Z = observed.lab(beta, gain_update=False).along_reference(beta).Z
            estimate = instrumental_variables(system.with_columns(columns), Z[:, columns], estimate.weights)
        half = intervals_of(system.with_columns(columns), estimate).half
        return {name: float(x) for name, x in zip(estimate.names, half, strict=True) if x > 0}
    return {}
