"""Least squares of friction terms that may be unidentifiable or depend on the previous estimate.

A term whose column is nearly a sum of others is left out, with a message. Load friction depends on the link torque of the
previous pass (`regression.load`): passes end when every parameter changes by less than half a deviation. The load friction
of a joint that does not converge is left out, with a message.
"""

from collections.abc import Callable, Collection
from typing import Literal

import numpy as np

from ..arrays import Array
from ..estimation import Estimate, System, condensed, ordinary_least_squares, weighted_least_squares
from ..model import SHAPES, JointTerm
from ..regression import LoadFriction, Problem, Regression
from .system import StackedSystem

MIN_INDEPENDENT_NORM = 0.02  # share of the norm of an identifiable column that is independent of the others
MAX_PASSES = 10
MIN_CHANGE = 1e-10  # of the largest value: smaller changes are rounding, also where exact data have no deviation


def solve_with_load_friction(
    observed: StackedSystem, method: Literal["ols", "wls"] = "wls"
) -> tuple[StackedSystem, Estimate]:
    """Least squares with the identifiable terms, and the system about the solution.

    Raises `IdentificationError` as the estimators.
    """
    solve = weighted_least_squares if method == "wls" else ordinary_least_squares
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
