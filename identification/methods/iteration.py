"""Iteration of the instrumental variable method: start, next values to simulate, end."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Estimate, System, intervals_of
from ..model import BaseParameters, InverseModel
from ..regression import Problem
from ..simulation import ClosedLoops, Instruments
from ..trust import covariance_of_all
from .fit import LeastSquares, Pass
from .settled import solve_with_load_friction
from .system import StackedSystem

MAX_FULL_STEPS = 4  # passes; later ones simulate the mean of the last two values, which damps oscillation


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """Settings of the iteration.

    `start`: `regular` (only a regular inertia matrix), `ls`, or the name of the source of the base parameters `values`.
    `tolerance_percent`, `max_iterations`: in place of the keys of robot.toml. `inertias` (n,) are those of the regular start,
    1 kg m² (or kg) by default.
    """

    start: str = "regular"
    tolerance_percent: float | None = None
    max_iterations: int | None = None
    values: Callable[[BaseParameters], Array] | None = None
    inertias: Array | None = None
    gain_update: bool = True


def start_values(observed: StackedSystem, iteration: Iteration, ls: LeastSquares) -> tuple[Array, Array | None]:
    """Values of all parameters to simulate first, and their covariance: None for a regular start."""
    problem, repeated, system = observed.problem, observed.parameters.repeated, observed.regression.system
    if iteration.start == "regular" and iteration.values is None:
        return repeated(regular_start(problem.model, problem.base, iteration.inertias)), None
    beta = ls.full.beta if iteration.values is None else repeated(iteration.values(problem.base))
    return beta, covariance_of_all(system.names, ls.full, intervals_of(system, ls.full), ls.full)


def next_values(passes: Sequence[Pass], names: tuple[str, ...]) -> Array:
    """Parameters (b,) to simulate next: the estimate, or in later passes its mean with the last values."""
    beta = passes[-1].estimate.values_of(names)
    return 0.5 * (beta + passes[-1].z.beta) if len(passes) >= MAX_FULL_STEPS else beta


def is_coarse(problem: Problem, start: str, passes: Sequence[Pass], most: int) -> bool:
    """Whether the next pass is coarse: the first from a regular start, and the second if no controller is described.

    Their estimates only start later passes. A described controller sets its own steps, so less time is saved. The last of the
    `most` passes is never coarse.
    """
    early = 0 if start != "regular" else 1 if problem.signals.robot.controller.structure else 2
    return len(passes) < min(early, most - 1)


@np.errstate(over="ignore", invalid="ignore")  # a start may be anything
def assess_pass(
    z: Instruments,
    estimate: Estimate,
    system: System,
    covariances: tuple[Array | None, Array],
    *,
    tolerance_percent: float,
) -> Pass:
    """The pass that gave `estimate`, its changes, and whether it settled.

    `system` has all parameters; `covariances` are those of the values simulated and the estimate.
    """
    # Compared with the values asked for, not with the consistent ones simulated instead. Parameters near zero never settle
    # in percent: half a deviation is enough.
    tolerance = 0.01 * tolerance_percent
    old = np.array([z.beta[system.names.index(name)] for name in estimate.names])
    change = np.abs(estimate.beta - old)
    w = estimate.weights[system.joint_of_row] * system.used
    norm_before = float(np.linalg.norm(w * (system.Y - system.W @ z.beta)))
    norm_change = abs(estimate.residual_norm - norm_before)
    with np.errstate(divide="ignore", invalid="ignore"):
        in_sigma = np.where(change > 0, change / estimate.sigma, 0.0)
        in_percent = np.where(np.abs(estimate.beta) > 2 * estimate.sigma, 100 * change / np.abs(estimate.beta), 0.0)
    return Pass(
        z=z,
        estimate=estimate,
        asked=covariances[0],
        covariance=covariances[1],
        change_sigma=float(in_sigma.max()),
        change_percent=float(in_percent.max()),
        changed=estimate.names[int(in_sigma.argmax())],
        residual_percent=100 * norm_change / norm_before if norm_before > 0 else 0.0,
        residual_settled=norm_change <= tolerance * norm_before,
        parameters_settled=bool((change <= np.maximum(tolerance * np.abs(estimate.beta), estimate.sigma / 2)).all()),
    )


def failed(passes: list[Pass], z: Instruments, recordings: Sequence[str], error: IdentificationError) -> list[Pass]:
    """The passes; the last one has the reason why the next, with the instruments `z`, gave no estimate.

    Raises `IdentificationError` if there is none.
    """
    text = f"pass {len(passes) + 1}: {error}"
    text += f"; {z.reason}" if z.reason else ""
    if not passes:
        raise IdentificationError(f"no instruments: {text}", place=", ".join(recordings)) from error
    return [*passes[:-1], replace(passes[-1], failure=text)]


def conclude(lab: ClosedLoops, passes: Sequence[Pass], solve: Callable[[Instruments], Estimate]) -> Pass:
    """The last pass if it settled; otherwise the one with the lowest tracking error at its worst joint.

    It has its instruments and replicas, simulated with its estimate or the nearest consistent parameters.
    """
    best, names = passes[-1], lab.parameters.names
    if not best.is_last or best.failure is not None:
        best = _best_pass(lab, passes)
    if best.number < len(passes):
        z = lab.instruments(best.z.beta, best.asked, coarse=best.coarse)
        best = replace(best, z=z, estimate=solve(z))
    return (
        best if best.replicas else replace(best, replicas=lab.replicas(best.estimate.values_of(names), best.covariance))
    )


def _best_pass(lab: ClosedLoops, passes: Sequence[Pass]) -> Pass:
    """The pass that tracks best when simulated with its estimate itself; the last if none can be simulated."""
    found = []
    for one in passes:
        replicas = lab.replicas(one.estimate.values_of(lab.parameters.names), None)
        if all(replica.direct for replica in replicas):
            joints = [d.position_error_percent for replica in replicas for d in replica.direct]
            percent = max((x for x in joints if x is not None), default=0.0)
            found.append((percent, one.number, replace(one, replicas=replicas)))
    return min(found, key=lambda one: one[:2])[2] if found else passes[-1]


def inertia_prior(observed: StackedSystem, ls: LeastSquares) -> Array:
    """Parameters (b,) for whose inertias the controller gains are assumed to be set: least squares at the rule's cut-off.

    Without that filter the inertias are poorly determined; it is left out if the recording is too short.
    """
    try:
        behind = observed.behind_rule()
        return (
            ls.full.beta
            if behind is None
            else solve_with_load_friction(behind)[1].values_of(observed.regression.system.names)
        )
    except IdentificationError:
        return ls.full.beta


def regular_start(model: InverseModel, base: BaseParameters, J: Array | None = None) -> Array:
    """Base parameters of a robot with only an inertia J of each motor, at its joint.

    With a coupled wrist the Ia of a joint includes all motors that turn with it: Ia5 = 2 on the TX40. A joint without Ia has
    a link with that inertia about every axis, or that mass.

    Returns (b,) values in the order of `base`.
    """
    chi, robot = np.zeros(model.p), model.robot
    J = np.ones(robot.n) if J is None else J
    place = {name: c for c, name in enumerate(model.names)}
    R = np.abs(robot.R) > 0
    for j, joint in enumerate(robot.joints):
        if joint.rotor_inertia:
            turning = [m for m in range(robot.n) if m != j and R[m, m] and R[m, j] and R[j].sum() == 1]
            shares = [J[m] * (robot.R[m, j] / robot.R[m, m]) ** 2 for m in turning]
            chi[place[f"Ia{j + 1}"]] = J[j] + sum(shares)
        elif joint.type == "revolute":
            for axis in ("XX", "YY", "ZZ"):
                chi[place[f"{axis}{j + 1}"]] = J[j]
        else:
            chi[place[f"M{j + 1}"]] = J[j]
    return np.asarray(base.K @ chi)
