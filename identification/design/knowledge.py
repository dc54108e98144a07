"""What is known of a robot before the motion: its parameters, the noise of its torque, earlier recordings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array
from ..data import Signals, load_signals
from ..errors import IdentificationError
from ..methods import stored_beta
from ..model import BaseParameters, DirectModel, InverseModel, base_parameters, load_parameters, truth
from ..regression import Overrides, decimation_rule, make_problem, regression_of_recording
from ..report import read_fit
from .series import Motion

NOISE_SHARE = 0.02  # of a joint's rms torque, where no noise is known
SAMPLE_RATE_HZ = 1000.0  # of a recording, where nothing states one


@dataclass(frozen=True, kw_only=True, eq=False)
class Knowledge:
    """What is known of the robot beforehand.

    Attributes:
        beta: (b,) base parameters that the torque is computed by; None where there are none.
        beta_from: their origin, in words.
        error_percent: (n,) torque error of a fit's rows in percent of the torque; None without a fit.
        correlation: (n,) of that error from row to row.
        noise: (n,) stated deviation of the torque; before the fit's.
        recordings: whose information adds to that of the reference.
        folder: of the description, where collision meshes of its URDF are looked for first.
    """

    beta: Array | None = None
    beta_from: str = ""
    error_percent: Array | None = None
    correlation: Array | None = None
    noise: Array | None = None
    recordings: Sequence[Signals] = ()
    folder: Path | None = None


def knowledge_of(
    robot: Robot,
    folder: Path | None = None,
    *,
    fit: Path | None = None,
    noise: Sequence[float] | None = None,
    after: Sequence[Path] = (),
) -> tuple[Knowledge, list[str]]:
    """What files and options know of a robot: a fit's parameters, else those of the description.

    Returns what is known, and warnings about the fit. Raises `IdentificationError`: where a file cannot be read, or is
    not of this robot.
    """
    if noise is not None and len(noise) not in (1, robot.n):
        expected = f"one number, or one for each of {robot.n} joints"
        raise IdentificationError(key="--noise", value=",".join(f"{x:g}" for x in noise), expected=expected)
    stated = None if noise is None else np.ones(robot.n) * noise
    recordings = [load_signals(path, None) for path in after]
    model = InverseModel(robot)
    base = base_parameters(model)
    if fit is None:
        beta = truth(model, base) if robot.parameters else None
        return Knowledge(beta=beta, beta_from="[parameters]", noise=stated, recordings=recordings, folder=folder), []
    stored = read_fit(fit)
    errors = stored.joints
    known = len(errors) == robot.n and all(e.autocorrelation is not None and e.percent is not None for e in errors)
    found = Knowledge(
        beta=stored_beta(stored, base, str(fit)),
        beta_from=fit.name,
        error_percent=np.array([e.percent for e in errors]) if known else None,
        correlation=np.array([e.autocorrelation for e in errors]) if known else None,
        noise=stated,
        recordings=recordings,
        folder=folder,
    )
    return found, stored.warnings_of(str(fit))


def torque_noise(
    robot: Robot, model: DirectModel | None, knowledge: Knowledge, motions: Sequence[Motion]
) -> tuple[Array, str]:
    """Deviation (n,) of each joint's torque in a row of the fit, and its origin in words.

    A stated one; else the error of a fit, in percent of the torque along `motions`, larger where it is correlated from row
    to row; else a share of that torque; else 1 for each joint, if no parameters give a torque.
    """
    if knowledge.noise is not None:
        return knowledge.noise, "as stated"
    if model is None:
        return np.ones(robot.n), "1 N m or N for each joint, for want of better"
    tau = np.concatenate([model.torque(*motion) for motion in motions])
    rms = np.sqrt(np.mean(tau**2, axis=0))
    rms = np.maximum(rms, 1e-6 * rms.max(initial=1e-9))
    if knowledge.error_percent is None or knowledge.correlation is None:
        return NOISE_SHARE * rms, f"{100 * NOISE_SHARE:g} % of the rms torque of the plain references"
    # r rows of correlation rho are worth r (1 - rho)/(1 + rho) independent ones.
    rho = np.clip(knowledge.correlation, 0.0, 0.95)
    noise = 0.01 * knowledge.error_percent * rms * np.sqrt((1 + rho) / (1 - rho))
    return np.maximum(noise, 1e-6 * rms), "the torque error of the fit"


def rows_per_s(robot: Robot) -> float:
    """Rows of the fit of a recording per second, by the rule of decimation."""
    rate_hz = robot.controller.sample_rate_hz or SAMPLE_RATE_HZ
    if robot.bus is not None:
        rate_hz = 1 / robot.bus.sync_period_s
    return rate_hz / decimation_rule(rate_hz, robot.bandwidth_hz)


def earlier_information(base: BaseParameters, noise: Array, recordings: Sequence[Signals], beta: Array | None) -> Array:
    """Sum of W'W / s² (b, b) over the rows of earlier recordings that count, load friction about the parameters beta (b,).

    Without parameters `base` lacks load friction.

    Raises `IdentificationError` where a recording is of a robot with other base parameters, or cannot be fitted.
    """
    M = np.zeros((base.b, base.b))
    for signals in recordings:
        problem = make_problem(signals, Overrides())
        own = problem.base if beta is not None else problem.base.without(load_parameters(problem.base))
        known = (own.names, own.units, own.expressions)
        if known != (base.names, base.units, base.expressions):
            expected = "a recording of the described robot: its base parameters are others"
            raise IdentificationError(place=signals.recording, key="robot", value=signals.robot.name, expected=expected)
        W, _ = regression_of_recording(replace(problem, base=own), beta=beta).system.weighted(1 / noise)
        M += W.T @ W
    return M
