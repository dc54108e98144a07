"""How late the recorded torque is against the motion, joint by joint, found with instruments.

To first order tau(t - L) = tau(t) - L d/dt tau(t): the column -d/dt(W beta), one for each joint in that joint's rows, takes the
coefficient L. Its instrument is -d/dt of the simulated torque, so that noise of the position does not bias it; least squares
would find a lag where there is none. Rows slower than a fifth of the peak are left out: friction that rises smoothly from a
reversal on, where the model has a step, looks like a lag. Residuals are whitened: noise of the position grows with frequency in
them, and drowns a lag otherwise.

A controller's command, recorded at its tick, acts from there until the next one: it is half a control period early.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import System, instrumental_variables, intervals, whitened
from ..regression import Problem, differentiate, fast_rows, torque_rate
from .evidence import Evidence, Part
from .lines import REDUCED, Figure, TrustLine

WIDEST = 0.25  # samples: a half-width beyond this does not tell one sample from none
FURTHEST = 0.25  # samples off the expected value
BEYOND = 4.0  # deviations off the expected value
SLOW_PERCENT = 20.0  # of the peak speed: rows slower than this are left out
ORDER = 6  # of the autoregression that whitens: shorter, model error passes for a lag; longer, few rows are left


@dataclass(frozen=True, kw_only=True, eq=False)
class Lags:
    """Lags of the torque by joint, (n,) each, in samples of the first recording; positive where the torque is late."""

    found: Array
    expected: float
    sigma: Array
    half: Array

    @property
    def off(self) -> Array:
        """How far they are off the expected value."""
        return self.found - self.expected

    @property
    def t(self) -> Array:
        """The same in deviations."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.off / self.sigma)


def lag_test(evidence: Evidence) -> TrustLine:
    """Whether torque and motion belong to the same instants."""
    reason = _not_made(evidence)
    if reason is None:
        try:
            return _line(evidence.problem, lags(evidence))
        except IdentificationError as error:
            reason = str(error)
    on_request = evidence.method != "iv" and evidence.Z is None and not evidence.observed.reduced
    advice = "; --trust or --method iv makes this test" if on_request else ": the delay is not verified"
    return TrustLine(test="lag", level="not made", value=None, text=f"not made: {reason}{advice}", caps=not on_request)


def lags(evidence: Evidence) -> Lags:
    """Lags by instrumental variables, with one more column for each joint.

    Raises `IdentificationError` where the instruments do not determine them.
    """
    problem, n, b = evidence.problem, evidence.problem.signals.robot.n, len(evidence.observed.system.names)
    system, Z = _with_lag_columns(evidence)
    first = instrumental_variables(system, Z, evidence.least_squares.weights)
    rho = system.Y - system.W @ first.beta
    parts = evidence.observed.parts
    system, Z = whitened(system, Z, rho, ORDER, parts)
    rho = (system.Y - system.W @ first.beta) * system.used
    size = np.sqrt(np.bincount(system.joint_of_row, weights=rho**2) / np.maximum(1, system.rows))
    estimate = instrumental_variables(system, Z, 1 / np.maximum(size, 1e-9 * size.max()))
    w = estimate.weights[system.joint_of_row] * system.used
    within = intervals(estimate, w * (system.Y - system.W @ estimate.beta), n, parts)
    return Lags(
        found=estimate.beta[b:] + _samples(problem, problem.settings.torque_lag_s),
        expected=_samples(problem, problem.settings.expected_lag_s),
        sigma=within.sigma[b:],
        half=within.half[b:],
    )


def _with_lag_columns(evidence: Evidence) -> tuple[System, Array]:
    """The system and the instruments with the lag columns, in rows that are fast."""
    assert evidence.Z is not None
    robot = evidence.problem.signals.robot
    rate, rate_simulated, fast = (
        np.concatenate(x, axis=1) for x in zip(*(_rates(evidence, part) for part in evidence.parts), strict=True)
    )
    system = evidence.observed.system.with_rows(fast.reshape(-1))
    own = np.eye(robot.n)[system.joint_of_row]  # a column for each joint, in its rows
    names = (*system.names, *(f"lag {joint.name}" for joint in robot.joints))
    W, Z = (np.c_[A, -own * r.reshape(-1, 1)] for A, r in ((system.W, rate), (evidence.Z, rate_simulated)))
    return replace(system, W=W, names=names), Z


def _rates(evidence: Evidence, part: Part) -> tuple[Array, Array, Array]:
    """Of a recording d/dt of the torque predicted and of the simulated one, and which rows are fast, (n, rows) each.

    Rates are per sample of the first recording.
    """
    problem, simulated, decimation = part.problem, part.simulated, part.decimation
    assert simulated is not None
    assert decimation is not None
    first_hz, own_hz = evidence.problem.signals.sample_rate_hz, problem.signals.sample_rate_hz
    per_sample = 1 / ((simulated.t_s[1] - simulated.t_s[0]) * first_hz)
    rate = torque_rate(problem, evidence.estimate.among(part.parameters)) * (own_hz / first_hz)
    rate_simulated = decimation.filtered(differentiate(simulated.tau, per_sample).T)
    directions = problem.model.coulomb_directions
    percent = max(SLOW_PERCENT, problem.settings.low_speed.iv or 0.0)
    slip = decimation.kept(simulated.dq) @ directions.T
    used = fast_rows(slip, part.slip_noise, directions, percent).T.astype(float)
    return rate.T, rate_simulated, used


def _not_made(evidence: Evidence) -> str | None:
    if evidence.observed.reduced:
        return REDUCED.removeprefix("not made: ")
    if evidence.Z is None:
        return "least squares has no instruments"
    if any(part.simulated is None for part in evidence.parts):
        return "the robot could not be simulated with the estimate"
    if any(part.reference != "recorded" for part in evidence.parts):
        return "the recording has no reference" if len(evidence.parts) == 1 else "a recording has no reference"
    corrections = [(p.settings.torque_lag_s, p.settings.expected_lag_s) for p in (x.problem for x in evidence.parts)]
    if len(set(corrections)) > 1:
        return "recordings whose torques have different lags by the description"
    return None


def _line(problem: Problem, found: Lags) -> TrustLine:
    names, fs = [joint.name for joint in problem.signals.robot.joints], problem.signals.sample_rate_hz
    figures = tuple(
        Figure(name=name, value=float(value), half_width=float(half), expected=found.expected)
        for name, value, half in zip(names, found.found, found.half, strict=True)
    )
    told = found.half <= WIDEST
    late = told & (np.abs(found.off) > FURTHEST) & (np.abs(found.t) > BEYOND)
    among = late if late.any() else told if told.any() else np.isfinite(found.half)
    worst = int(np.argmax(np.where(among, np.abs(found.off), -1.0)))
    value = float(found.found[worst])
    text = f"joint {names[worst]}: torque {value:.2f} ± {found.half[worst]:.2f} samples late, {found.expected:.2g} expected"
    blind = [name for name, is_told in zip(names, told, strict=True) if not is_told]
    unknown = f"the interval is wider than {WIDEST:g} samples for {', '.join(blind)}" if blind else ""
    if late.any():
        text += f", t = {found.t[worst]:.1f}: state torque_lag_s = {value / fs:.3g} if this is the drive's delay"
        return TrustLine(test="lag", level="caution", value=value, text=text, figures=figures, unit="samples")
    if blind:
        text = unknown if not told.any() else f"{text}; {unknown}"
        return TrustLine(test="lag", level="cannot tell", value=value, text=text, figures=figures, unit="samples")
    return TrustLine(test="lag", level="ok", value=value, text=text, figures=figures, unit="samples")


def _samples(problem: Problem, seconds: float) -> float:
    return seconds * problem.signals.sample_rate_hz
