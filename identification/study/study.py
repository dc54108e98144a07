"""Monte-Carlo on the simulated robot: what least squares and instrumental variables give where the truth is known.

Each run simulates a recording with known parameters and imperfections of the cell, and fits it at one cut-off, from a wrong
start and told of a wrong controller, by least squares and by instrumental variables.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Robot, robot_from_files

from ..arrays import Array
from ..data import Work
from ..errors import IdentificationError
from ..estimation import one_thread
from ..methods import Fit, Iteration, identify_iv, identify_ls
from ..model import BaseParameters, InverseModel, base_parameters, direct_model, inertias, not_positive, poses_of, truth
from ..regression import CUTOFF_PER_BANDWIDTH, Overrides, decimation_rule
from .draws import Draw, Study, draw, told_robot
from .synthetic import closed_loop, random_reference


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """What a fit says of itself, and what is true of it.

    Attributes:
        verdict: of its tests; `doubts` the names of those that say caution or worse, not made ones apart.
        low, high: (b,) its 95 % intervals.
        essential: (b,) which parameters the recording determines well.
        positive: whether M of the estimate is positive on the reference.
    """

    verdict: str
    doubts: tuple[str, ...]
    low: Array
    high: Array
    essential: NDArray[np.bool_]
    positive: bool

    def off(self, true: Array) -> Array:
        """(b,) distances of the true values from the middles of the intervals, in half-widths."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.abs(self.low + self.high - 2 * true) / (self.high - self.low))


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One run. Errors are |beta - true| / |true| over all parameters; vectors are (b,).

    `positive` says whether M of the estimate is positive on the reference; `error_tuned_ls` is that of least squares on the
    same recording at the rule's cut-off. A method that gives no estimate has NaN; `reason` says why a status of IV is not
    `converged`. `drawn` has the rest of what the run was made with, `ls` and `iv` what each fit says of itself.
    """

    number: int
    cutoff: float
    start: float
    gain_error: float
    status: str = "diverged"
    reason: str | None = None
    passes: int = 0
    positive: bool = False
    error_ls: float = float("nan")
    error_iv: float = float("nan")
    error_tuned_ls: float = float("nan")
    beta_ls: Array
    beta_iv: Array
    sigma_ls: Array
    sigma_iv: Array
    drawn: Draw | None = None
    ls: Judged | None = None
    iv: Judged | None = None


def run_study(robot: Robot, study: Study, work: Work) -> Iterator[Run]:
    """All runs of a study.

    Returns the runs in order; one that fails has a `reason`. Raises `IdentificationError`: where no run can succeed: no
    values in the description, a cut-off above half the rate.
    """
    fs, bandwidth_hz = study.sample_rate_hz, robot.bandwidth_hz
    study_truth(robot)
    if max(study.cutoffs) * bandwidth_hz >= fs / 2:
        raise IdentificationError(
            f"cut-off {max(study.cutoffs):g} x bandwidth = {max(study.cutoffs) * bandwidth_hz:g} Hz: expected below "
            f"{fs / 2:g} Hz, half the rate"
        )
    return work.run(run_of_files, [(dict(robot.files), study, number) for number in range(study.runs)])


@one_thread
def run_of_files(files: dict[str, bytes], study: Study, number: int) -> Run:
    """Run `number` of a study of the robot that these files describe."""
    return one_run(robot_from_files(files, "study"), study, number)


def one_run(robot: Robot, study: Study, number: int) -> Run:
    """Run `number` of a study: the same number gives the same run."""
    fs, bandwidth_hz = study.sample_rate_hz, robot.bandwidth_hz
    drawn = draw(study, number, bandwidth_hz)
    q_ref = random_reference(
        robot, duration_s=study.duration_s, sample_rate_hz=fs, seed=drawn.seed, period_s=study.period_s
    )
    idm = InverseModel(robot)
    base = base_parameters(idm)
    true, poses = truth(idm, base), poses_of(q_ref)
    n_d = robot.identification.decimation or decimation_rule(fs, bandwidth_hz)
    overrides = Overrides(
        cutoff_hz=drawn.cutoff * bandwidth_hz, decimation=n_d, low_speed_percent=study.low_speed_percent
    )
    nan = np.full(base.b, np.nan)
    run = Run(
        number=number,
        cutoff=drawn.cutoff,
        start=drawn.start,
        gain_error=drawn.gain_error,
        drawn=drawn,
        beta_ls=nan,
        beta_iv=nan,
        sigma_ls=nan,
        sigma_iv=nan,
    )
    J = inertias(direct_model(idm, base.standard_parameters(true)), poses)

    def off(fit: Fit) -> float:
        return float(np.linalg.norm(fit.beta - true) / np.linalg.norm(true))

    def judged(fit: Fit) -> Judged:
        model = direct_model(idm, base.standard_parameters(fit.beta))
        doubts = tuple(line.test for line in fit.trust.lines if line.level in ("do not use", "caution"))
        essential = np.isin(np.arange(base.b), fit.essential.kept)
        positive = not_positive(model, poses) is None
        low, high = fit.intervals.low, fit.intervals.high
        return Judged(
            verdict=fit.trust.verdict, doubts=doubts, low=low, high=high, essential=essential, positive=positive
        )

    try:
        signals = closed_loop(robot, q_ref, fs, noise=drawn.noise, seed=drawn.seed)
        signals = replace(signals, robot=told_robot(robot, drawn))
        ls = tuned = identify_ls(signals, overrides)
        if drawn.cutoff != CUTOFF_PER_BANDWIDTH:
            tuned = identify_ls(signals, replace(overrides, cutoff_hz=CUTOFF_PER_BANDWIDTH * bandwidth_hz))
    except IdentificationError as error:
        return replace(run, reason=str(error))
    run = replace(
        run, error_ls=off(ls), error_tuned_ls=off(tuned), beta_ls=ls.beta, sigma_ls=ls.estimate.sigma, ls=judged(ls)
    )
    try:
        iv = identify_iv(signals, overrides, Iteration(inertias=drawn.start * J))
    except IdentificationError as error:
        return replace(run, reason=str(error))
    assert iv.iv is not None
    found = judged(iv)
    return replace(
        run,
        status=iv.status,
        reason=iv.iv.reason,
        passes=len(iv.iv.passes),
        positive=found.positive,
        error_iv=off(iv),
        beta_iv=iv.beta,
        sigma_iv=iv.estimate.sigma,
        iv=found,
    )


def study_truth(robot: Robot) -> tuple[BaseParameters, Array]:
    """The base parameters of the robot and the values (b,) a study simulates with."""
    idm = InverseModel(robot)
    base = base_parameters(idm)
    return base, truth(idm, base)
