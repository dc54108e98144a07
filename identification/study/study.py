"""Monte-Carlo on the simulated robot: what least squares and instrumental variables give where the truth is known.

Each run simulates a recording with known parameters and sensor noise, and fits it at one cut-off, from a wrong start and
with wrong controller gains, by least squares and by instrumental variables.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from typing import Any

import msgspec
import numpy as np

from acquisition.robot import Robot, robot_from_files

from ..arrays import Array
from ..errors import IdentificationError
from ..methods import Iteration, identify_iv, identify_ls
from ..model import BaseParameters, InverseModel, base_parameters, direct_model
from ..regression import CUTOFF_PER_BANDWIDTH, Overrides, decimation_rule
from ..trust import inertias, not_positive, poses_of
from .noise import Noise
from .synthetic import PERIOD_S, closed_loop, random_reference, truth

FALSE_ERROR = 5.0  # times the error of least squares at the rule's cut-off


@dataclass(frozen=True, kw_only=True)
class Study:
    """What is varied. Each run draws one of each list, seeded by its number.

    `cutoffs` are in multiples of the bandwidth, 0 for none; `starts` factors on each joint's true inertia, all that the start
    knows of the robot (`instruments.regular_start`); `gain_errors` factors on the controller's gains (on the bandwidth of a
    surrogate) as the fit knows them.
    """

    runs: int = 100
    noise: Noise = field(default_factory=Noise)
    cutoffs: tuple[float, ...] = (5.0, 10.0, 0.0)
    starts: tuple[float, ...] = (0.05, 1.0, 20.0)
    gain_errors: tuple[float, ...] = (0.7, 1.0, 1.3)
    duration_s: float = 10.0
    period_s: float = PERIOD_S
    sample_rate_hz: float = 1000.0
    low_speed_percent: float | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One run. Errors are |beta - true| / |true| over all parameters; vectors are (b,).

    `positive` says whether M of the estimate is positive on the reference; `error_tuned_ls` is that of least squares on the
    same recording at the rule's cut-off. A method that gives no estimate has NaN; `reason` says why a status of IV is not
    `converged`.
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
    hac_ls: Array
    hac_iv: Array


_PER_METHOD = ("beta", "sigma", "hac", "error")


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary:
    """Runs at one cut-off by one method: of wls those with an estimate, of iv those that converged. NaN where there are none.

    `bias_percent` and `spread_percent` are norms over all parameters in percent of the norm of the true ones;
    `sigma_over_spread` and `hac_over_spread` medians over the parameters of reported deviation by observed one;
    `within_percent` is the share of true values within three deviations, formula or HAC, whichever is larger.
    `false_percent` is the share of runs called converged whose M is not positive, or whose error is over `FALSE_ERROR`
    times that of least squares at the rule's cut-off on the same recording. By luck that may be right to many digits.
    """

    method: str
    cutoff: float
    runs: int
    bias_percent: float
    spread_percent: float
    sigma_over_spread: float
    hac_over_spread: float
    within_percent: float
    median_error_percent: float
    worst_error_percent: float
    converged_percent: float | None
    mean_passes: float | None
    false_percent: float | None


def run_study(robot: Robot, study: Study) -> Iterator[Run]:
    """All runs of a study, on all cores.

    Parameters
    ----------
    robot : described with `[parameters]`.
    study : what is varied.

    Returns
    -------
    The runs in order; one that fails has a `reason`.

    Raises
    ------
    IdentificationError : where no run can succeed: no values in the description, a cut-off above half the rate.
    """
    fs, bandwidth_hz = study.sample_rate_hz, robot.controller.bandwidth_hz
    study_truth(robot)
    if max(study.cutoffs) * bandwidth_hz >= fs / 2:
        raise IdentificationError(
            f"cut-off {max(study.cutoffs):g} x bandwidth = {max(study.cutoffs) * bandwidth_hz:g} Hz: expected below "
            f"{fs / 2:g} Hz, half the rate"
        )
    return _all_runs([(dict(robot.files), study, number) for number in range(study.runs)])


def _all_runs(jobs: list[tuple[dict[str, bytes], Study, int]]) -> Iterator[Run]:
    # One thread of linear algebra per process: the processes are the parallelism.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with ProcessPoolExecutor(max_workers=os.cpu_count(), mp_context=get_context("spawn")) as pool:
        yield from pool.map(_job, jobs, chunksize=1)


def _job(job: tuple[dict[str, bytes], Study, int]) -> Run:
    files, study, number = job
    return one_run(robot_from_files(files, "study"), study, number)


def one_run(robot: Robot, study: Study, number: int) -> Run:
    """Run `number` of a study: the same number gives the same run."""
    rng = np.random.default_rng([study.seed, number])
    cutoff, start = float(rng.choice(study.cutoffs)), float(rng.choice(study.starts))
    gain_error = float(rng.choice(study.gain_errors))
    fs, seed = study.sample_rate_hz, int(rng.integers(2**31))
    q_ref = random_reference(robot, duration_s=study.duration_s, sample_rate_hz=fs, seed=seed, period_s=study.period_s)
    idm = InverseModel(robot)
    base = base_parameters(idm)
    true = truth(idm, base)
    bandwidth_hz = robot.controller.bandwidth_hz
    n_d = robot.identification.decimation or decimation_rule(fs, bandwidth_hz)
    overrides = Overrides(cutoff_hz=cutoff * bandwidth_hz, decimation=n_d, low_speed_percent=study.low_speed_percent)
    nan = np.full(base.b, np.nan)
    run = Run(
        number=number,
        cutoff=cutoff,
        start=start,
        gain_error=gain_error,
        beta_ls=nan,
        beta_iv=nan,
        sigma_ls=nan,
        sigma_iv=nan,
        hac_ls=nan,
        hac_iv=nan,
    )
    J = inertias(direct_model(idm, base.standard_parameters(true)), poses_of(q_ref))
    try:
        signals = closed_loop(robot, q_ref, fs, noise=study.noise, seed=seed)
        ls = tuned = identify_ls(signals, overrides)
        if cutoff != CUTOFF_PER_BANDWIDTH:
            tuned = identify_ls(signals, replace(overrides, cutoff_hz=CUTOFF_PER_BANDWIDTH * bandwidth_hz))
    except IdentificationError as error:
        return replace(run, reason=str(error))

    def off(beta: Array) -> float:
        return float(np.linalg.norm(beta - true) / np.linalg.norm(true))

    run = replace(
        run,
        error_ls=off(ls.beta),
        error_tuned_ls=off(tuned.beta),
        beta_ls=ls.beta,
        sigma_ls=ls.estimate.sigma,
        hac_ls=ls.sigma_hac,
    )
    misinformed = replace(signals, robot=_misinformed(robot, gain_error))
    try:
        iv = identify_iv(misinformed, overrides, Iteration(inertias=start * J))
    except IdentificationError as error:
        return replace(run, reason=str(error))
    assert iv.iv is not None
    return replace(
        run,
        status=iv.status,
        reason=iv.iv.reason,
        passes=len(iv.iv.passes),
        positive=not_positive(direct_model(idm, base.standard_parameters(iv.beta)), poses_of(q_ref)) is None,
        error_iv=off(iv.beta),
        beta_iv=iv.beta,
        sigma_iv=iv.estimate.sigma,
        hac_iv=iv.sigma_hac,
    )


def study_truth(robot: Robot) -> tuple[BaseParameters, Array]:
    """The base parameters of the robot and the values (b,) a study simulates with."""
    idm = InverseModel(robot)
    base = base_parameters(idm)
    return base, truth(idm, base)


def _misinformed(robot: Robot, factor: float) -> Robot:
    """The robot with its controller's gains as the fit is told them; of a surrogate, its bandwidth."""
    c = robot.controller
    if c.structure is None:
        return replace(robot, controller=msgspec.structs.replace(c, bandwidth_hz=factor * c.bandwidth_hz))
    scaled = {
        name: tuple(factor * g for g in gains)
        for name in ("position_gain", "velocity_gain")
        if (gains := getattr(c, name)) is not None
        and not (name == "position_gain" and c.structure.startswith("cascade"))
    }
    return replace(robot, controller=msgspec.structs.replace(c, **scaled))


def summaries(runs: Sequence[Run], true: Array) -> list[Summary]:
    """One summary per cut-off and method; `true` (b,) are the values simulated with."""
    found = []
    for cutoff in sorted({r.cutoff for r in runs}, key=lambda c: c or np.inf):
        here = [r for r in runs if r.cutoff == cutoff]
        settled = [r for r in here if r.status == "converged"]
        solved = [r for r in here if np.isfinite(r.error_ls)]
        for method, used in (("wls", solved), ("iv", settled)):
            kind = "ls" if method == "wls" else "iv"
            beta, sigma, hac, errors = (_stacked(used, f"{name}_{kind}", true) for name in _PER_METHOD)
            spread = beta.std(axis=0, ddof=1) if len(used) > 1 else np.full(len(true), np.nan)
            off = np.abs(beta - true)
            found.append(
                Summary(
                    method=method,
                    cutoff=cutoff,
                    runs=len(used),
                    bias_percent=float(100 * np.linalg.norm(beta.mean(axis=0) - true) / np.linalg.norm(true)),
                    spread_percent=float(100 * np.linalg.norm(spread) / np.linalg.norm(true)),
                    sigma_over_spread=float(np.median(np.median(sigma, axis=0) / spread)),
                    hac_over_spread=float(np.median(np.median(hac, axis=0) / spread)),
                    within_percent=float(100 * (off <= 3 * np.maximum(sigma, hac)).mean()) if used else np.nan,
                    median_error_percent=float(100 * np.median(errors)),
                    worst_error_percent=float(100 * errors.max()),
                    converged_percent=100 * len(settled) / len(here) if method == "iv" else None,
                    mean_passes=float(np.mean([r.passes for r in settled])) if method == "iv" and settled else None,
                    false_percent=100 * sum(map(_false, here)) / len(here) if method == "iv" else None,
                )
            )
    return found


def _stacked(runs: Sequence[Run], name: str, true: Array) -> Array:
    """An attribute of all runs (runs, ...); a row of NaN where there are no runs."""
    return np.array([getattr(run, name) for run in runs]) if runs else np.full((1, len(true)), np.nan)


def _false(run: Run) -> bool:
    """Whether a run is called converged and should not be."""
    return run.status == "converged" and not (run.positive and run.error_iv <= FALSE_ERROR * run.error_tuned_ls)


def study_json(study: Study, runs: Sequence[Run], names: Sequence[str], true: Array) -> dict[str, Any]:
    """A study as JSON: settings, `names` (b,) and `true` (b,) of the base parameters, summaries, every run."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return [plain(float(x)) for x in value]
        return None if isinstance(value, float) and not np.isfinite(value) else value

    def fields(value: Any) -> dict[str, Any]:
        return {name: plain(x) for name, x in vars(value).items()}

    return {
        "study": {**vars(study), "noise": vars(study.noise)},
        "parameters": list(names),
        "true": [float(x) for x in true],
        "summaries": [fields(s) for s in summaries(runs, true)],
        "runs": [fields(r) for r in runs],
    }
