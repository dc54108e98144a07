"""Monte-Carlo study of least squares and instrumental variables on simulated robots with known parameters.

Each run simulates a recording with imperfections of the cell. It fits the recording at one cut-off, from a wrong start and
with a wrong controller, by least squares and by instrumental variables.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Payload, Robot, robot_from_files

from ..arrays import Array
from ..data import Work
from ..errors import IdentificationError
from ..estimation import one_thread
from ..methods import Fit, Iteration, identify_iv, identify_ls
from ..model import (
    InverseModel,
    base_parameters,
    described_parameters,
    direct_model,
    inertias,
    poses_of,
    why_not_positive,
)
from ..options import Controllers, StudyOptions
from ..regression import CUTOFF_PER_BANDWIDTH, Overrides, decimation_rule
from .simulated_cell import Noise, closed_loop, random_reference, study_truth, write_signals


@dataclass(frozen=True, kw_only=True)
class Study(StudyOptions):
    """What a study varies. Each run draws one value of each list, seeded by its number.

    `cutoffs` are multiples of the bandwidth, 0 for none; `starts` are factors on each joint's true inertia, the only values in
    the start; `gain_errors` are factors on the controller's gains (or a surrogate's bandwidth) that the fit gets;
    `controllers`: the fit gets the described control law, or none. `vary`: each run has the imperfections of `noise`, or
    draws `everything`: any controller and any noise, and in half of the runs imperfections that a description lacks.
    """

    noise: Noise = field(default_factory=Noise)


def simulate_recording(robot: Robot, out: Path, study: Study, payload: Payload | None = None) -> None:
    """Write a recording of the robot of `[parameters]`: length, rate, seed and imperfections are those of a study.

    Raises `IdentificationError`: a value or limit of the description is missing.
    """
    fs, seed = study.sample_rate_hz, study.seed
    q_ref = random_reference(robot, duration_s=study.duration_s, sample_rate_hz=fs, seed=seed, period_s=study.period_s)
    signals = closed_loop(robot, q_ref, fs, noise=study.noise, seed=seed, payload=payload)
    write_signals(out, signals, source=f"simulated: random reference and noise of seed {seed}", noise=study.noise)


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """Settings of one run; `seed` of its reference and noise."""

    cutoff: float
    start: float
    gain_error: float
    seed: int
    controller: Controllers
    noise: Noise

    @property
    def modelled(self) -> bool:
        """Whether the fit knows everything except the noise."""
        return self.noise.modelled and (self.gain_error == 1.0 or self.controller == "none")


def draw(study: Study, number: int, bandwidth_hz: float) -> RunSettings:
    """Settings of run `number` of a study: the same number gives the same settings."""
    rng = np.random.default_rng([study.seed, number])
    cutoff, start = float(rng.choice(study.cutoffs)), float(rng.choice(study.starts))
    gain_error, seed = float(rng.choice(study.gain_errors)), int(rng.integers(2**31))
    if study.vary == "everything":
        noise = _draw_noise(study.noise, rng, bandwidth_hz)
        controllers: tuple[Controllers, ...] = ("described", "described", "none")
    else:
        noise, controllers = study.noise, study.controllers
    controller = controllers[rng.integers(len(controllers))]
    return RunSettings(cutoff=cutoff, start=start, gain_error=gain_error, seed=seed, controller=controller, noise=noise)


def _draw_noise(noise: Noise, rng: np.random.Generator, bandwidth_hz: float) -> Noise:
    """Random noise, encoder step near that of `noise`; in half of the runs also imperfections that no description has."""

    def some(low: float, high: float) -> float:
        return float(rng.uniform(low, high)) if rng.random() < 0.5 else 0.0

    step = noise.encoder_step * 10 ** rng.uniform(-1.0, 0.3)
    sensors = Noise(
        encoder_step=step,
        position=some(0.0, 2.0) * step,
        effort_percent=some(0.5, 5.0),
        coloured_percent=some(0.5, 3.0),
        disturbance_percent=some(0.5, 3.0),
        recorded="tick" if rng.random() < 0.5 else "mean",
    )
    if rng.random() < 0.5:
        return sensors
    return replace(
        sensors,
        lag_samples=round(some(0.5, 5.5)),
        stribeck_percent=some(10.0, 50.0),
        asymmetry_percent=some(5.0, 30.0),
        integral_hz=some(0.05, 0.3) * bandwidth_hz,
    )


def robot_given_to_fit(robot: Robot, drawn: RunSettings) -> Robot:
    """The robot with the controller that the fit gets: wrong gains, or only a wrong bandwidth."""
    c, factor = robot.controller, drawn.gain_error
    if drawn.controller == "none":
        keys = ("structure", "sample_rate_hz", "position_gain", "velocity_gain", "integral_gain", "velocity_estimate")
        c = msgspec.structs.replace(c, **dict.fromkeys(keys))
    if c.structure is None:
        return replace(robot, controller=msgspec.structs.replace(c, bandwidth_hz=factor * robot.bandwidth_hz))
    scaled = {
        name: tuple(factor * g for g in gains)
        for name in ("position_gain", "velocity_gain")
        if (gains := getattr(c, name)) is not None
        and not (name == "position_gain" and c.structure.startswith("cascade"))
    }
    return replace(robot, controller=msgspec.structs.replace(c, **scaled))


@dataclass(frozen=True, kw_only=True, eq=False)
class RunFit:
    """The fit of a run by one method, compared with the truth. Vectors are (b,).

    Attributes:
        error: |beta - true| / |true| over all parameters.
        verdict: of its tests; `doubts`: names of tests with level `caution` or `do not use`.
        low, high: its 95 % intervals.
        essential: whether the recording determines a parameter well.
        positive: whether M of the estimate is positive on the reference.
    """

    beta: Array
    sigma: Array
    error: float
    verdict: str
    doubts: tuple[str, ...]
    low: Array
    high: Array
    essential: NDArray[np.bool_]
    positive: bool

    @property
    def half(self) -> Array:
        """(b,) half-widths of the intervals."""
        return 0.5 * (self.high - self.low)

    def half_widths_off(self, true: Array) -> Array:
        """(b,) distances of the true values from the middles of the intervals, in half-widths."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.abs(self.low + self.high - 2 * true) / (self.high - self.low))


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One run, and its fits if it has any.

    `status` and `passes` are those of IV; `reason`: why it is not `converged`, or why there is no fit; `error_tuned_ls`: the
    error of least squares on the same recording at the default cut-off.
    """

    number: int
    drawn: RunSettings
    status: str = "diverged"
    reason: str | None = None
    passes: int = 0
    error_tuned_ls: float = float("nan")
    ls: RunFit | None = None
    iv: RunFit | None = None


def run_study(robot: Robot, study: Study, work: Work) -> Iterator[Run]:
    """All runs of a study.

    Returns the runs in order; one that fails has a `reason`. Raises `IdentificationError`: if no run can succeed (no values in
    the description, or a cut-off above half the rate).
    """
    fs, highest_hz = study.sample_rate_hz, max(study.cutoffs) * robot.bandwidth_hz
    study_truth(robot)
    if highest_hz >= fs / 2:
        raise IdentificationError(
            f"cut-off {max(study.cutoffs):g} x bandwidth = {highest_hz:g} Hz: expected below {fs / 2:g} Hz, half the rate"
        )
    return work.run(one_run, [(dict(robot.files), study, number) for number in range(study.runs)])


@one_thread
def one_run(files: Mapping[str, bytes], study: Study, number: int) -> Run:
    """Run `number` of a study of the robot described by `files`: the same number gives the same run."""
    robot = robot_from_files(files, "study")
    fs, bandwidth_hz = study.sample_rate_hz, robot.bandwidth_hz
    drawn = draw(study, number, bandwidth_hz)
    q_ref = random_reference(
        robot, duration_s=study.duration_s, sample_rate_hz=fs, seed=drawn.seed, period_s=study.period_s
    )
    idm = InverseModel(robot)
    base = base_parameters(idm)
    true, poses = described_parameters(idm, base), poses_of(q_ref)
    overrides = Overrides(
        cutoff_hz=drawn.cutoff * bandwidth_hz,
        decimation=robot.identification.decimation or decimation_rule(fs, bandwidth_hz),
        low_speed_percent=study.low_speed_percent,
    )
    J = inertias(direct_model(idm, base.standard_parameters(true)).inertia(poses))
    run = Run(number=number, drawn=drawn)

    def result(fit: Fit) -> RunFit:
        return RunFit(
            beta=fit.beta,
            sigma=fit.estimate.sigma,
            error=float(np.linalg.norm(fit.beta - true) / np.linalg.norm(true)),
            verdict=fit.trust.verdict,
            doubts=tuple(line.test for line in fit.trust.lines if line.level in ("do not use", "caution")),
            low=fit.intervals.low,
            high=fit.intervals.high,
            essential=np.isin(np.arange(base.b), fit.essential.kept),
            positive=why_not_positive(direct_model(idm, base.standard_parameters(fit.beta)).inertia(poses)) is None,
        )

    try:
        signals = closed_loop(robot, q_ref, fs, noise=drawn.noise, seed=drawn.seed)
        signals = replace(signals, robot=robot_given_to_fit(robot, drawn))
        ls = tuned = identify_ls(signals, overrides)
        if drawn.cutoff != CUTOFF_PER_BANDWIDTH:
            tuned = identify_ls(signals, replace(overrides, cutoff_hz=CUTOFF_PER_BANDWIDTH * bandwidth_hz))
        run = replace(run, error_tuned_ls=result(tuned).error, ls=result(ls))
        iv = identify_iv(signals, overrides, Iteration(inertias=drawn.start * J))
    except IdentificationError as error:
        return replace(run, reason=str(error))
    assert iv.iv is not None
    return replace(run, status=iv.status, reason=iv.iv.reason, passes=len(iv.iv.passes), iv=result(iv))
