"""How the instrumental variable method iterates: where it starts, what it simulates next, which rows count, where it ends."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Estimate
from ..model import BaseParameters, InverseModel
from ..regression import Problem
from ..simulation import Instruments, Lab, Replica, has_controller
from ..trust import covariance_of_all
from .assess import intervals_of
from .fit import LeastSquares, Pass
from .recordings import Observed

ROWS_FREE = 3  # passes that choose their own rows; later ones keep them, otherwise rows near the threshold toggle
RELAXED_AFTER = 4  # passes; later ones simulate the mean of the last two, which ends going to and fro


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """How the instrumental variable method iterates.

    `start`: `regular` (an inertia matrix that is regular, nothing else known), `ls`, or base parameters from `values`
    under the name they were read from. `inertias` (n,) are those of the regular start, 1 kg m² (or kg) by default.
    """

    start: str = "regular"
    values: Callable[[BaseParameters], Array] | None = None
    inertias: Array | None = None
    tolerance_percent: float = 2.5
    max_iterations: int = 10
    gain_update: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """A pass: its instruments, the estimate they give, and whether it was simulated coarsely.

    `covariance` (b, b) is that of all base parameters, with honest deviations; `asked` the one that instruments were asked for
    with.
    """

    z: Instruments
    estimate: Estimate
    covariance: Array
    asked: Array | None
    evidence: Pass
    coarse: bool

    def without_rows(self) -> "Trial":
        """The same without what is as large as W: only the last pass needs that."""
        return replace(self, z=self.z.without_rows(), estimate=self.estimate.without_rows())

    @property
    def settled(self) -> bool:
        """Whether it is the last: a fixed point, of instruments that are not coarse."""
        return self.evidence.settled and not self.coarse


@dataclass(frozen=True, kw_only=True, eq=False)
class IterationResult:
    """How the iteration ended.

    Attributes:
        estimate: that of the pass number `returned`, counted from 1.
        z: the instruments that gave it.
        asked: covariance that these were asked for with; `covariance` (b, b) that of the estimate.
        final: the robot simulated with it in each recording, or with the nearest consistent parameters.
        passes: all of them.
        start: what the iteration started from.
        failure: why it could not go on, None where it could.
    """

    estimate: Estimate
    z: Instruments
    asked: Array | None
    covariance: Array
    final: tuple[Replica, ...]
    passes: tuple[Pass, ...]
    returned: int
    start: str
    failure: str | None


def start_values(observed: Observed, iteration: Iteration, ls: LeastSquares) -> tuple[Array, Array | None]:
    """Values of all parameters that are simulated first, and their covariance: None of a regular start."""
    problem, repeated, rows = observed.problem, observed.parameters.repeated, observed.regression
    if iteration.start == "regular" and iteration.values is None:
        return repeated(regular_start(problem.model, problem.base, iteration.inertias)), None
    beta = ls.full.beta if iteration.values is None else repeated(iteration.values(problem.base))
    found = intervals_of(rows, ls.full, observed.predicted(ls.full), rows.system.used)
    return beta, covariance_of_all(rows.system.names, ls.full, found, ls.full)


def next_values(trials: Sequence[Trial], names: tuple[str, ...]) -> Array:
    """Base parameters (b,) to simulate next: the estimate, later its mean with those asked for last."""
    beta = trials[-1].estimate.among(names)
    return 0.5 * (beta + trials[-1].z.beta) if len(trials) >= RELAXED_AFTER else beta


def is_coarse(problem: Problem, iteration: Iteration, trials: Sequence[Trial]) -> bool:
    """Whether the next pass is simulated coarsely: the first from a regular start, and a second where a PD stands in.

    Their estimates are only where the passes after them start. A described controller sets steps of its own, so that there
    is less to save. The last pass allowed is never coarse.
    """
    early = 0 if iteration.start != "regular" else 1 if has_controller(problem.signals.robot.controller) else 2
    return len(trials) < min(early, iteration.max_iterations - 1)


def kept_rows(trials: Sequence[Trial]) -> tuple[NDArray[np.bool_], ...] | None:
    """By recording the rows (rows, n) that count in the next pass, or None where the simulated speeds tell."""
    return trials[-1].z.fast if len(trials) >= ROWS_FREE else None


def conclude(
    lab: Lab,
    iteration: Iteration,
    trials: Sequence[Trial],
    failure: str | None,
    solve: Callable[[Instruments], Estimate],
) -> IterationResult:
    """The last pass where it settled; otherwise the pass whose simulated robot tracks best at its worst joint.

    Raises `IdentificationError` where there was no pass.
    """
    if not trials:
        raise IdentificationError(f"no instruments: {failure}", place=", ".join(lab.names))
    returned, final = len(trials) - 1, None
    if not trials[-1].settled or failure is not None:
        returned, final = _best_pass(lab, trials)
    trial = trials[returned]
    z, estimate = trial.z, trial.estimate
    if returned < len(trials) - 1:
        z = lab.instruments(z.beta, trial.asked, estimate.weights, kept=z.fast, coarse=trial.coarse)
        estimate = solve(z)
    return IterationResult(
        estimate=estimate,
        z=z,
        asked=trial.asked,
        covariance=trial.covariance,
        final=final or lab.replicas(estimate.among(lab.parameters.names), trial.covariance),
        passes=tuple(trial.evidence for trial in trials),
        returned=returned + 1,
        start=iteration.start,
        failure=failure,
    )


def _best_pass(lab: Lab, trials: Sequence[Trial]) -> tuple[int, tuple[Replica, ...] | None]:
    """Where there is no fixed point, the place of the pass whose simulated robot tracks best at its worst joint.

    Robots are simulated with the estimates themselves, not with the nearest consistent parameters. The last pass where none
    can be simulated.
    """
    found = []
    for place, trial in enumerate(trials):
        replicas = lab.replicas(trial.estimate.among(lab.parameters.names), None)
        if all(one.direct for one in replicas):
            joints = [d.position_error_percent for one in replicas for d in one.direct]
            found.append((max((x for x in joints if x is not None), default=0.0), place, replicas))
    return min(found, key=lambda one: one[:2])[1:] if found else (len(trials) - 1, None)


def inertia_prior(observed: Observed, ls: LeastSquares) -> Array:
    """Parameters (b,) whose inertias the controllers' gains are taken to be set for: least squares at the rule's cut-off.

    Without that filter least squares says little of the inertias; it is taken where the recording is too short to filter.
    """
    try:
        behind = observed.behind_rule()
        return ls.full.beta if behind is None else behind.settled()[1].among(observed.regression.system.names)
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
