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
from numpy.typing import NDArray

from acquisition.robot import Robot, robot_from_files

from . import IdentificationError
from .base_parameters import BaseParameters, base_parameters
from .dynamics import Dynamics, direct_model
from .idim import Iteration, identify_iv, identify_ls
from .instruments import inertias, not_positive, regular_start
from .plan import CUTOFF_PER_BANDWIDTH, Overrides, decimation_rule
from .synthetic import Noise, closed_loop, random_reference, truth

Vector = NDArray[np.float64]


FALSE_ERROR = 5.0  # times the error of least squares at the rule's cut-off


@dataclass(frozen=True, kw_only=True)
class Study:
    """What is varied. Each run draws one of each list, seeded by its number.

    `cutoffs` are in multiples of the bandwidth, 0 for none; `starts` factors on the smallest joint's true inertia, given to
    every joint; `gain_errors` factors on the controller's gains (on the bandwidth of a surrogate) as the fit knows them.
    """

    runs: int = 100
    noise: Noise = field(default_factory=Noise)
    cutoffs: tuple[float, ...] = (5.0, 10.0, 0.0)
    starts: tuple[float, ...] = (0.05, 1.0, 20.0)
    gain_errors: tuple[float, ...] = (0.7, 1.0, 1.3)
    duration_s: float = 10.0
    sample_rate_hz: float = 1000.0
    low_speed_percent: float | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One run. Errors are |beta - true| / |true| over all parameters; vectors are (b,).

    `positive` says whether M of the estimate is positive on the reference; `error_tuned_ls` is that of least squares on the
    same recording at the rule's cut-off. An IV that gives no estimate has NaN, and its `status` is the reason.
    """

    number: int
    cutoff: float
    start: float
    gain_error: float
    status: str
    reason: str | None
    passes: int
    positive: bool
    error_ls: float
    error_iv: float
    error_tuned_ls: float
    beta_ls: Vector
    beta_iv: Vector
    sigma_ls: Vector
    sigma_iv: Vector
    hac_ls: Vector
    hac_iv: Vector


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary:
    """Runs at one cut-off by one method; of iv those that converged.

    `bias_percent` and `spread_percent` are norms over all parameters in percent of the norm of the true ones;
    `sigma_over_spread` and `hac_over_spread` medians over the parameters of reported deviation by observed one.
    `false_percent` is the share of runs called converged whose M is not positive, or whose error is over `FALSE_ERROR`
    times that of least squares at the rule's cut-off on the same recording.
    """

    method: str
    cutoff: float
    runs: int
    bias_percent: float
    spread_percent: float
    sigma_over_spread: float
    hac_over_spread: float
    median_error_percent: float
    worst_error_percent: float
    converged_percent: float | None
    mean_passes: float | None
    false_percent: float | None


def run_study(robot: Robot, study: Study) -> Iterator[Run]:
    """All runs on all cores, as they finish. Raises `IdentificationError` where the robot cannot be simulated."""
    jobs = [(dict(robot.files), study, number) for number in range(study.runs)]
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
    q_ref = random_reference(robot, duration_s=study.duration_s, sample_rate_hz=fs, seed=seed)
    signals = closed_loop(robot, q_ref, fs, noise=study.noise, seed=seed)
    idm = Dynamics(robot)
    base = base_parameters(idm)
    true = truth(idm, base)
    bandwidth_hz = robot.controller.bandwidth_hz
    n_d = robot.identification.decimation or decimation_rule(fs, bandwidth_hz)
    overrides = Overrides(cutoff_hz=cutoff * bandwidth_hz, decimation=n_d)
    tuned = identify_ls(signals, replace(overrides, cutoff_hz=CUTOFF_PER_BANDWIDTH * bandwidth_hz))
    ls = tuned if cutoff == CUTOFF_PER_BANDWIDTH else identify_ls(signals, overrides)
    poses = q_ref[:: max(1, len(q_ref) // 300)]
    J = inertias(direct_model(idm, base.representative(true)), poses)
    wrong = start * J.min() * regular_start(idm, base)
    nan = np.full(base.b, np.nan)
    beta_iv, sigma_iv, hac_iv, status, reason, passes = nan, nan, nan, "diverged", None, 0
    try:
        iv = identify_iv(
            replace(signals, robot=_misinformed(robot, gain_error)),
            overrides,
            Iteration(start=f"{start:g} x", values=lambda _: wrong, low_speed_percent=study.low_speed_percent),
        )
        assert iv.iv is not None
        beta_iv, sigma_iv, hac_iv = iv.beta, iv.estimate.sigma, iv.sigma_hac
        status, reason, passes = iv.status, iv.iv.reason, len(iv.iv.passes)
    except IdentificationError as error:
        reason = str(error)
    positive = (
        bool(np.isfinite(beta_iv).all())
        and not_positive(direct_model(idm, base.representative(beta_iv)), poses) is None
    )

    def off(beta: Vector) -> float:
        return float(np.linalg.norm(beta - true) / np.linalg.norm(true))

    return Run(
        number=number,
        cutoff=cutoff,
        start=start,
        gain_error=gain_error,
        status=status,
        reason=reason,
        passes=passes,
        positive=positive,
        error_ls=off(ls.beta),
        error_iv=off(beta_iv),
        error_tuned_ls=off(tuned.beta),
        beta_ls=ls.beta,
        beta_iv=beta_iv,
        sigma_ls=ls.estimate.sigma,
        sigma_iv=sigma_iv,
        hac_ls=ls.sigma_hac,
        hac_iv=hac_iv,
    )


def study_truth(robot: Robot) -> tuple[BaseParameters, Vector]:
    """The base parameters of the robot and the values (b,) a study simulates with."""
    idm = Dynamics(robot)
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


def summaries(runs: Sequence[Run], true: Vector) -> list[Summary]:
    """One summary per cut-off and method."""
    found = []
    for cutoff in sorted({r.cutoff for r in runs}, key=lambda c: c or np.inf):
        here = [r for r in runs if r.cutoff == cutoff]
        settled = [r for r in here if r.status == "converged"]
        for method, used in (("wls", here), ("iv", settled)):
            kind = "ls" if method == "wls" else "iv"
            if not used:
                continue
            beta, sigma, hac = (
                np.array([getattr(r, f"{name}_{kind}") for r in used]) for name in ("beta", "sigma", "hac")
            )
            errors = 100 * np.array([getattr(r, f"error_{kind}") for r in used])
            spread = beta.std(axis=0, ddof=1) if len(used) > 1 else np.full(len(true), np.nan)
            found.append(
                Summary(
                    method=method,
                    cutoff=cutoff,
                    runs=len(used),
                    bias_percent=float(100 * np.linalg.norm(beta.mean(axis=0) - true) / np.linalg.norm(true)),
                    spread_percent=float(100 * np.linalg.norm(spread) / np.linalg.norm(true)),
                    sigma_over_spread=float(np.median(np.median(sigma, axis=0) / spread)),
                    hac_over_spread=float(np.median(np.median(hac, axis=0) / spread)),
                    median_error_percent=float(np.median(errors)),
                    worst_error_percent=float(errors.max()),
                    converged_percent=100 * len(settled) / len(here) if method == "iv" else None,
                    mean_passes=float(np.mean([r.passes for r in settled])) if method == "iv" else None,
                    false_percent=100 * sum(map(_false, here)) / len(here) if method == "iv" else None,
                )
            )
    return found


def _false(run: Run) -> bool:
    """Whether a run is called converged and should not be."""
    return run.status == "converged" and not (run.positive and run.error_iv <= FALSE_ERROR * run.error_tuned_ls)


def study_json(study: Study, runs: Sequence[Run], names: Sequence[str], true: Vector) -> dict[str, Any]:
    """A study as JSON: settings, truth, summaries, every run."""

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
