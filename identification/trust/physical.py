"""Whether estimated parameters can be those of a robot: M > 0 along the trajectory, no friction or rotor inertia below zero.

No method sees to that by itself: an effort or a position of the wrong sign fits as well as one of the right sign, with
inertias and friction below zero. What is below zero by more than three deviations, the larger of formula and HAC, cannot be
chance. For M that is judged along single directions v: v'M(q)v is linear in beta, g(q, v)'beta with g'Cg as its variance. Tried
at each pose are each joint alone, and the eigenvector of the lowest eigenvalue.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import Estimate
from ..model import DirectModel, InverseModel, JointTerm
from ..regression import Problem

POSES = 300  # positions of the trajectory at which M must be positive
BEYOND = 3.0  # deviations below zero that chance does not explain


@dataclass(frozen=True, kw_only=True)
class Doubt:
    """Something that no robot has; `severe` where chance does not explain it."""

    text: str
    severe: bool


def poses_of(q: Array) -> Array:
    """Some 300 positions (P, n) of a trajectory q (N, n), evenly spaced, at which the inertia matrix M is looked at."""
    return q[:: max(1, len(q) // POSES)]


def inertias(model: DirectModel, poses: Array) -> Array:
    """J_j (n,) in kg m² or kg: the largest diagonal entry of M for each joint over the poses (P, n)."""
    M = model.inertia(poses)
    return np.asarray(np.diagonal(M, axis1=1, axis2=2).max(axis=0))


def not_positive(model: DirectModel, poses: Array) -> str | None:
    """None where M is positive definite at all poses (P, n), else a line that says so."""
    M = model.inertia(poses)
    if not np.isfinite(M).all():
        return "the inertia matrix is not finite on the trajectory"
    lowest = float(np.linalg.eigvalsh(M).min())
    return (
        None if lowest > 0 else f"the inertia matrix is not positive on the trajectory (lowest eigenvalue {lowest:.3g})"
    )


def physical_doubts(problem: Problem, estimate: Estimate, sigma_hac: Array) -> tuple[Doubt, ...]:
    """What of an estimate no robot has; `sigma_hac` (b,) may be NaN. Each text names the joint to look at."""
    signals, settings, idm, base = problem.signals, problem.settings, problem.model, problem.base
    spread = np.fmax(estimate.sigma, sigma_hac)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(estimate.sigma > 0, spread / estimate.sigma, 1.0)
    # The formula's correlations with the larger deviations.
    covariance = estimate.covariance * scale[:, None] * scale
    among = np.array([base.names.index(name) for name in estimate.names])
    names = tuple(joint.name for joint in signals.robot.joints)
    inertia = _inertia_doubt(
        idm, base.columns[among], estimate.beta, covariance, poses_of(signals.q[settings.start : settings.stop])
    )
    found = [] if inertia is None else [inertia]
    below: dict[int, list[str]] = {}
    for i, value, sigma in zip(among, estimate.beta, spread, strict=True):
        terms = [idm.sources[c] for c in np.flatnonzero(base.K[i])]
        resisting = all(isinstance(t, JointTerm) and t.kind in ("rotor", "viscous", "coulomb") for t in terms)
        if resisting and (base.K[i] >= 0).all() and value < -BEYOND * sigma:
            joint = int(base.names[i].removesuffix("R").lstrip("FIvcamnp")) - 1
            below.setdefault(joint, []).append(f"{base.names[i]} = {value:.4g} ± {sigma:.2g} {base.units[i]}")
    for joint, told in sorted(below.items()):
        found.append(Doubt(text=f"below zero: {', '.join(told)}: {_question(names[joint])}", severe=True))
    return tuple(found)


def _question(name: str) -> str:
    return f"look at the sign of effort and position of joint {name}"


def _inertia_doubt(
    idm: InverseModel, columns: NDArray[np.intp], beta: Array, covariance: Array, q: Array
) -> Doubt | None:
    """None where M is positive at all poses (P, n)."""
    P, n = q.shape
    zero = np.zeros_like(q)
    at_rest = idm.regressor(q, zero, zero)[:, :, columns]
    # M e_j = IDM(q, 0, e_j) - IDM(q, 0, 0), linear in beta.
    G = np.stack(
        [idm.regressor(q, zero, zero + np.eye(n)[j])[:, :, columns] - at_rest for j in range(n)], axis=2
    )  # (P, n, n, b)
    M = G @ beta
    values, vectors = np.linalg.eigh(0.5 * (M + M.transpose(0, 2, 1)))
    if values[:, 0].min() > 0:
        return None
    directions = np.concatenate([np.tile(np.eye(n), (P, 1, 1)), vectors[:, None, :, 0]], axis=1)  # (P, n + 1, n)
    g = np.einsum("pdi,pijb,pdj->pdb", directions, G, directions)
    lowest, sigma = g @ beta, np.sqrt(np.maximum(np.einsum("pdb,bc,pdc->pd", g, covariance, g), 0.0))
    severe = bool((lowest < -BEYOND * sigma).any())
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = np.unravel_index(int(np.nanargmin(np.where(lowest < 0, lowest / sigma, 0.0))), lowest.shape)
    joint = int(np.abs(directions[worst]).argmax())
    told = f"the inertia matrix is not positive on the trajectory (lowest eigenvalue {values[:, 0].min():.3g}"
    told += f"; {lowest[worst]:.3g} ± {sigma[worst]:.2g} about joint {idm.robot.joints[joint].name})"
    return Doubt(text=f"{told}: {_question(idm.robot.joints[joint].name)}", severe=severe)
