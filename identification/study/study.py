"""Monte-Carlo study: simulated recordings of a robot with known parameters, each fitted by
both methods as users fit.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from acquisition.robot import Payload, Robot, robot_from_files

from ..arrays import Array, Bools
from ..data import Signals, Work
from ..errors import RobotIdimError
from ..estimation import one_thread
from ..methods import Iteration
from ..model import InverseModel, direct_model, poses_of, why_not_positive
from ..options import StudyOptions
from ..regression import Overrides
from ..results import Evidence, identify_iv, identify_ls
from .simulated_cell import Noise, closed_loop, random_reference, study_truth, write_signals


@dataclass(frozen=True, kw_only=True)
class Study(StudyOptions):
    """Number, length, rate and noise of the simulated recordings; the seed of each
    follows from its number.
    """

    noise: Noise = field(default_factory=Noise)


def simulate_recording(
    robot: Robot, out: Path, study: Study, payload: Payload | None = None
) -> None:
    """Write a recording of the robot of `[parameters]`: length, rate, seed and
    noise are those of a study.
    """
    write_signals(
        out,
        _simulated(robot, study, study.seed, payload),
        source=f"simulated: random reference and noise of seed {study.seed}",
        noise=study.noise,
    )


def _simulated(robot: Robot, study: Study, seed: int, payload: Payload | None = None) -> Signals:
    fs = study.sample_rate_hz
    return closed_loop(
        robot,
        random_reference(robot, duration_s=study.duration_s, sample_rate_hz=fs, seed=seed),
        fs,
        noise=study.noise,
        seed=seed,
        payload=payload,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class RunFit:
    """The fit of a run by one method, compared with the truth. Vectors are (b,).

    Attributes:
        error: |beta - true| / |true| over all parameters.
        low, high: the 95 % intervals.
        verdict: of the fit's tests.
        essential: whether the recording determines a parameter well.
        positive: whether M of the estimate is positive along the motion.
    """

    beta: Array
    error: float
    low: Array
    high: Array
    verdict: str
    essential: Bools
    positive: bool

    def half_widths_off(self, true: Array) -> Array:
        """(b,) distances of the true values from the middles of the intervals, in half-widths."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.abs(self.low + self.high - 2 * true) / (self.high - self.low))


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One run, and its fits if it has any.

    `status` is that of IV; `reason`: why it is not `converged`, or why there is no fit.
    """

    number: int
    status: str = "diverged"
    reason: str | None = None
    ls: RunFit | None = None
    iv: RunFit | None = None


def run_study(robot: Robot, study: Study, work: Work) -> Iterator[Run]:
    """All runs in order; one that fails has a `reason`.

    Raises `BadInputError`: the description has no values.
    """
    study_truth(robot)
    if robot.controller.structure is None:
        _ = robot.bandwidth_hz  # of the PD that is simulated: refused before any run
    return work.run(one_run, [(dict(robot.files), study, number) for number in range(study.runs)])


@one_thread
def one_run(files: Mapping[str, bytes], study: Study, number: int) -> Run:
    """Run `number` of a study of the robot described by `files`: the same
    number gives the same run.
    """
    robot, run = robot_from_files(files, "study"), Run(number=number)
    base, true = study_truth(robot)

    def result(fit: Evidence) -> RunFit:
        model = direct_model(InverseModel(robot), base.standard_parameters(fit.beta))
        return RunFit(
            beta=fit.beta,
            error=float(np.linalg.norm(fit.beta - true) / np.linalg.norm(true)),
            low=fit.intervals.low,
            high=fit.intervals.high,
            verdict=fit.trust.verdict,
            essential=np.isin(base.names, fit.essential.names),
            positive=why_not_positive(model.inertia(poses_of(signals.q))) is None,
        )

    try:
        signals = _simulated(
            robot, study, int(np.random.default_rng([study.seed, number]).integers(2**31))
        )
        ls = identify_ls(signals, Overrides())
        run = replace(run, ls=result(ls))
        iv = identify_iv(signals, Overrides(law=ls.law), Iteration())
    except RobotIdimError as error:
        return replace(run, reason=error.args[0])
    return replace(run, status=iv.status, reason=iv.solution.reason, iv=result(iv))
