"""How the instrumental variable method iterates: where it starts, what it simulates next, which rows count, where it ends."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Estimate, System
from ..model import BaseParameters, InverseModel
from ..options import IterationOptions
from ..regression import Problem
from ..simulation import ClosedLoops, Instruments
from ..trust import covariance_of_all
from .assess import intervals_of
from .fit import LeastSquares, Pass
from .settled import solve_with_load_friction
from .system import StackedSystem

ROWS_FREE = 3  # passes that choose their own rows; later ones keep them, otherwise rows near the threshold toggle
RELAXED_AFTER = 4  # passes; later ones simulate the mean of the last two, which ends going to and fro


@dataclass(frozen=True, kw_only=True)
class Iteration(IterationOptions):
    """How the instrumental variable method iterates.

    `start`: `regular` (an inertia matrix that is regular, nothing else known), `ls`, or base parameters from `values`
    under the name they were read from. `inertias` (n,) are those of the regular start, 1 kg m² (or kg) by default.
    """

    values: Callable[[BaseParameters], Array] | None = None
    inertias: Array | None = None
    gain_update: bool = True


def start_values(observed: StackedSystem, iteration: Iteration, ls: LeastSquares) -> tuple[Array, Array | None]:
    """Values of all parameters that are simulated first, and their covariance: None of a regular start."""
    problem, repeated, rows = observed.problem, observed.parameters.repeated, observed.regression
    if iteration.start == "regular" and iteration.values is None:
        return repeated(regular_start(problem.model, problem.base, iteration.inertias)), None
    beta = ls.full.beta if iteration.values is None else repeated(iteration.values(problem.base))
    found = intervals_of(rows, ls.full, observed.predicted(ls.full), rows.system.used)
    return beta, covariance_of_all(rows.system.names, ls.full, found, ls.full)


def next_values(passes: Sequence[Pass], names: tuple[str, ...]) -> Array:
    """Base parameters (b,) to simulate next: the estimate, later its mean with those asked for last."""
    beta = passes[-1].estimate.values_of(names)
    return 0.5 * (beta + passes[-1].z.beta) if len(passes) >= RELAXED_AFTER else beta


def is_coarse(problem: Problem, iteration: Iteration, passes: Sequence[Pass]) -> bool:
    """Whether the next pass is simulated coarsely: the first from a regular start, and a second where a PD stands in.

    Their estimates are only where the passes after them start. A described controller sets steps of its own, so that there
    is less to save. The last pass allowed is never coarse.
    """
    early = 0 if iteration.start != "regular" else 1 if problem.signals.robot.controller.structure else 2
    return len(passes) < min(early, iteration.max_iterations - 1)


def kept_rows(passes: Sequence[Pass]) -> tuple[NDArray[np.bool_], ...] | None:
    """By recording the rows (rows, n) that count in the next pass, or None where the simulated speeds tell."""
    return passes[-1].z.moving_rows if len(passes) >= ROWS_FREE else None


@np.errstate(over="ignore", invalid="ignore")  # a start may be anything
def assess_pass(
    z: Instruments,
    estimate: Estimate,
    system: System,
    covariances: tuple[Array | None, Array],
    *,
    tolerance_percent: float,
) -> Pass:
    """A pass that led from the parameters asked for to `estimate`, and whether it settled.

    `system` has all parameters and the rows that this pass used; `covariances` are that asked for and that of the estimate.
    """
    # Compared with what was asked for, not with what was simulated in its place. Parameters near zero never settle in percent
    # of themselves: half a deviation is enough.
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
    """The passes, the last of which knows why the one after it, with the instruments `z`, gave no estimate.

    Raises `IdentificationError` where there was none before.
    """
    text = f"pass {len(passes) + 1}, {100 * z.used.mean():.0f} % of the rows fast enough: {error}"
    text += f"; {z.reason}" if z.reason else ""
    if not passes:
        raise IdentificationError(f"no instruments: {text}", place=", ".join(recordings)) from error
    return [*passes[:-1], replace(passes[-1], failure=text)]


def conclude(lab: ClosedLoops, passes: Sequence[Pass], solve: Callable[[Instruments], Estimate]) -> Pass:
    """The last pass where it settled; otherwise the one whose simulated robot tracks best at its worst joint.

    It has its rows, and the robot simulated with its estimate in each recording, or with the nearest consistent parameters.
    """
    best, names = passes[-1], lab.parameters.names
    if not best.is_last or best.failure is not None:
        best = _best_pass(lab, passes)
    if best.number < len(passes):
        z = lab.instruments(best.z.beta, best.asked, best.estimate.weights, rows=best.z.moving_rows, coarse=best.coarse)
        best = replace(best, z=z, estimate=solve(z))
    return (
        best if best.replicas else replace(best, replicas=lab.replicas(best.estimate.values_of(names), best.covariance))
    )


def _best_pass(lab: ClosedLoops, passes: Sequence[Pass]) -> Pass:
    """The pass that tracks best, robots being simulated with the estimates themselves; the last if none can be."""
    found = []
    for one in passes:
        replicas = lab.replicas(one.estimate.values_of(lab.parameters.names), None)
        if all(replica.direct for replica in replicas):
            joints = [d.position_error_percent for replica in replicas for d in replica.direct]
            percent = max((x for x in joints if x is not None), default=0.0)
            found.append((percent, one.number, replace(one, replicas=replicas)))
    return min(found, key=lambda one: one[:2])[2] if found else passes[-1]


def inertia_prior(observed: StackedSystem, ls: LeastSquares) -> Array:
    """Parameters (b,) whose inertias the controllers' gains are taken to be set for: least squares at the rule's cut-off.

    Without that filter least squares says little of the inertias; it is taken where the recording is too short to filter.
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
    """Base parameters of a robot of which nothing is known but that each motor turns J at its joint.

    With a coupled wrist the Ia of a joint counts all motors that turn with it: Ia5 = 2 on the TX40. A joint without Ia has
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
