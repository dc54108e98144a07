"""The described control law, given the recorded reference and position, against the effort that was recorded.

The law does not depend on the robot's model, so the test detects what a fit cannot: an effort of the wrong scale or sign, which
scales every parameter and fits equally well. Units are those of the recorded effort: the drive gain cancels and is not tested.
"""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from acquisition.files import release_pages

from ..arrays import Array
from ..errors import IdentificationError
from ..model import direct_model
from ..regression import KnownLag, Problem, differentiate, sampled_at
from ..simulation import Control, ControlLaw, Reference, recorded_loop
from .fit_data import FitData
from .lines import LEVELS, Figure, TrustLine

DRIVE_DELAY_S = 0.0005  # deviation of the delay from command to torque
MAX_GAIN_ERROR, MAX_ERROR_PERCENT = 0.02, 5.0  # beyond: caution
MAX_REPLAYED_S = 600.0  # of a long recording
MAX_FIRST_LAG = 20  # samples, of the first guess
LEAD_SAMPLES = MAX_FIRST_LAG + 3  # replayed before those compared, for the lag and the velocity estimate
LAG_PASSES = 3  # Gauss-Newton steps
MAX_LAG_STEP = 10.0  # samples
MAX_MIRRORED_PERCENT = 50.0  # residual of a negative gain; below, the effort has the wrong sign
MIN_EFFORT_RATIO = 1e-9  # of the largest effort; joints with less are not compared


def replay_test(evidence: FitData) -> TrustLine:
    """Whether the described controllers give the recorded efforts: the line of the worst recording."""
    worst, name = min(zip(evidence.replays, evidence.names, strict=True), key=lambda one: _rank(one[0]))
    if len(evidence.names) == 1:
        return worst
    reason = worst.text.removeprefix("not made: ")
    return replace(worst, text=f"{'not made: ' if reason != worst.text else ''}{name}: {reason}")


def _rank(line: TrustLine) -> tuple[int, float]:
    """Sort key: the worst level, then the gain furthest from one."""
    return LEVELS.index(line.level), -abs((1.0 if line.value is None else line.value) - 1.0)


def replay_line(problem: Problem) -> tuple[TrustLine, KnownLag | None]:
    """Whether the described controller gives the recorded effort, and the lag of the torque by it, without an estimate.

    A command acts from its tick to the next one, on average half a period later; the drive's own delay is not included.
    """
    signals, reason, loop = problem.signals, "[controller] describes no control law, or not all of it", None
    with suppress(IdentificationError):  # described in part
        loop = recorded_loop(signals.robot)
    if signals.q_ref is None:
        reason, loop = "the recording has no reference", None
    elif signals.of_drives:
        reason = "the drive's internal loop is not described, so drive gain and delay cannot be checked"
        loop = None
    elif loop is not None and loop.computed_torque:
        reason, loop = "computed torque depends on the robot's own model", None
    if loop is None:
        return TrustLine("replay", "not made", f"not made: {reason}"), None
    found = replay(problem, loop)
    _, lag, lag_sd, _, left = found
    line = _line([joint.name for joint in signals.robot.joints], found)
    if loop.gravity_at_q:
        line = replace(line, text=f"{line.text}; gravity that is fed forward is fitted and subtracted")
    similar = np.nan_to_num(left, nan=np.inf) <= MAX_ERROR_PERCENT
    if not similar.any():
        return line, None
    value_s = float(lag[similar].mean()) / signals.sample_rate_hz - 0.5 * loop.period_s
    sd_s = float(np.hypot(lag_sd[similar].max() / signals.sample_rate_hz, DRIVE_DELAY_S))
    return line, KnownLag(value_s=value_s, sd_s=sd_s, source="the replay of the described controller")


def replay(problem: Problem, loop: ControlLaw) -> Array:
    """Gains, lags, their deviations and two errors (5, n) of the described law, after the decimation of torques.

    The recorded effort is gain times the replayed one, `lag` samples later; the lag's deviation assumes white noise. Errors, in
    percent of the effort, are the residuals with a gain of one and with the gain found, both corrected for the lag and for the
    initial integral. NaN for a joint whose law gives no effort.
    """
    effort, replayed = _efforts(problem, loop)
    size = np.abs(replayed).max(axis=0)
    found = np.full((5, len(size)), np.nan)
    for j in np.flatnonzero(size > MIN_EFFORT_RATIO * max(size.max(), np.abs(effort).max())):
        free = _gravity(problem, int(j)) if loop.gravity_at_q else np.ones((len(effort), int(loop.Ki.any())))
        found[:, j] = _compare(problem, effort[:, j : j + 1], replayed[:, j : j + 1], free)
    return found


def _gravity(problem: Problem, joint: int) -> Array:
    """The regressor's columns (N, k) of gravity and offset at the recorded positions, for a joint; and ones."""
    q, columns = problem.recorded.q[: _stop(problem)], problem.base.columns
    few = q[:: max(1, len(q) // 300)]
    acts = problem.model.regressor(few, 0 * few, 0 * few)[..., columns][:, joint].any(axis=0)
    entries = problem.model.entries(columns[acts])
    series = problem.model.series(q, 0 * q, 0 * q, columns[acts])
    return np.column_stack([series[entries[:, 0] == joint].T, np.ones(len(q))])


def _compare(problem: Problem, effort: Array, replayed: Array, free: Array) -> tuple[float, float, float, float, float]:
    """Gain, lag in samples and its deviation, errors in percent of efforts (N, 1).

    Multiples of the columns `free` (N, k) are subtracted: the unknown start of the integral, and gravity that is fed forward.
    """
    settings, decimation = problem.settings, problem.settings.decimator
    start, stop = max(settings.start, LEAD_SAMPLES), _stop(problem)
    measured = decimation.filtered(effort[start:stop].T)[0]
    norm, gain, sd, error, left = float(np.linalg.norm(measured)), 1.0, 0.0, 0.0, 0.0
    extra = decimation.filtered(free[start:stop].T).T
    rest = effort[start:stop, 0] - replayed[start:stop, 0]
    rest = effort[start:stop, 0] - free[start:stop] @ np.linalg.lstsq(free[start:stop], rest)[0]
    lag = _whole_lag(rest, replayed[:, 0], start)
    for _ in range(LAG_PASSES):
        law = sampled_at(np.arange(start, stop, dtype=np.float64) - lag, replayed)
        rows = [decimation.filtered(x.T)[0] for x in (law, -differentiate(law, 1.0))]
        A = np.column_stack([*rows, extra])
        solution, *_ = np.linalg.lstsq(A, measured)
        gain = float(solution[0])
        step = float(np.clip(solution[1] / gain, -MAX_LAG_STEP, MAX_LAG_STEP)) if gain else 0.0
        rho = measured - rows[0] - step * rows[1]
        rho = rho - extra @ np.linalg.lstsq(extra, rho)[0]
        error, left = (
            100 * float(np.linalg.norm(r)) / norm if norm > 0 else np.inf for r in (rho, measured - A @ solution)
        )
        sd = 0.01 * left * norm / np.sqrt(len(measured)) / max(abs(gain) * float(np.linalg.norm(rows[1])), 1e-300)
        lag += step
    return gain, lag, sd, error, left


def _whole_lag(effort: Array, replayed: Array, start: int) -> float:
    """The lag in whole samples at which a multiple of the replayed effort (N,) fits `effort` best, from `start` on."""
    lags = np.arange(max(-MAX_FIRST_LAG, start + len(effort) - len(replayed)), min(MAX_FIRST_LAG, start) + 1)
    shifted = [replayed[start - lag : start - lag + len(effort)] for lag in lags]
    explained = [(effort @ law) ** 2 / max(float(law @ law), 1e-300) for law in shifted]
    return float(lags[int(np.argmax(explained))])


def _efforts(problem: Problem, loop: ControlLaw) -> tuple[Array, Array]:
    """Recorded and replayed joint efforts (N, n) past the last replayed sample; zero where not replayed."""
    signals, fs = problem.recorded, problem.signals.sample_rate_hz
    assert signals.q_ref is not None
    first, last = max(0, problem.settings.start - LEAD_SAMPLES), _stop(problem) - 1
    count = int((last - first) / (loop.period_s * fs) + 1e-6) + 1
    ticks = first + loop.period_s * fs * np.arange(count, dtype=np.float64)
    q, q_ref = sampled_at(ticks, signals.q), sampled_at(ticks, signals.q_ref)
    v = differentiate(q, 1 / loop.period_s)
    dq_ref = differentiate(q_ref, 1 / loop.period_s)
    ahead = None if signals.feedforward is None else signals.feedforward[np.rint(ticks).astype(np.intp)]
    reference = Reference(q_ref, dq_ref, differentiate(dq_ref, 1 / loop.period_s), feedforward=ahead)
    release_pages(signals.q)
    release_pages(signals.q_ref)
    model = direct_model(problem.model, np.zeros(problem.model.p))  # without gravity, which is fitted
    control = Control(model, loop, q[0], (q[1] - q[0]) / loop.period_s)
    control.take(reference)
    given = np.array([control.torque(k, q[k], v[k]) for k in range(len(q))])
    effort = signals.effort[: last + 1 + LEAD_SAMPLES]
    replayed, samples = np.zeros_like(effort), np.arange(first, last + 1, dtype=np.float64)
    replayed[first : last + 1] = sampled_at((samples - first) / (loop.period_s * fs), given)
    return effort, replayed


def _stop(problem: Problem) -> int:
    """End of the replayed samples."""
    settings = problem.settings
    return min(settings.stop, settings.start + round(MAX_REPLAYED_S * problem.signals.sample_rate_hz))


def _line(names: list[str], found: Array) -> TrustLine:
    gains, lag, _, error, left = found
    figures = tuple(
        Figure(name=name, value=float(gain), expected=1.0)
        for name, gain in zip(names, gains, strict=True)
        if np.isfinite(gain)
    )
    if not figures:
        return TrustLine("replay", "cannot tell", "the described law gives no effort")
    off, error = np.nan_to_num(np.abs(gains - 1)), np.nan_to_num(error)
    mirrored = (gains < 0) & (left < MAX_MIRRORED_PERCENT)
    worst = int(np.argmax(np.maximum(np.maximum(off / MAX_GAIN_ERROR, error / MAX_ERROR_PERCENT), 1e9 * mirrored)))
    gain = float(gains[worst])
    text = f"joint {names[worst]}: recorded effort = {gain:.4g} x what the described controller gives"
    text += f", error {error[worst]:.2g} %, {lag[worst]:.2f} samples late"
    if mirrored.any():
        return TrustLine("replay", "do not use", f"{text}: check the sign of its effort", gain, figures=figures)
    if off[worst] > MAX_GAIN_ERROR or error[worst] > MAX_ERROR_PERCENT:
        text += ": check rated value, ratio, sample rate, structure and gains of [controller]"
        return TrustLine("replay", "caution", text, gain, figures=figures)
    return TrustLine("replay", "ok", text, gain, figures=figures)
