"""The bandwidth of a position loop that the description does not state: from how the joints follow their reference."""

from dataclasses import replace

import msgspec
import numpy as np

from ..arrays import Array
from ..data import Signals
from ..errors import IdentificationError
from ..model import InverseModel, base_parameters, poses_of
from ..options import Overrides
from .filtering import lowpass
from .motion import differentiate
from .settings import CUTOFF_PER_BANDWIDTH

MAX_DEVIATION = 0.1  # of an estimated bandwidth
_CUTOFF_HZ, _CUTOFF_SHARE = 30.0, 0.1  # of the fitted tracking; the latter of the sample rate
_SAMPLES, _ROWS, _RCOND = 200_000, 3000, 1e-6  # most samples, rows of the fit, and its smallest singular value
_FLOOR, _SEGMENTS = 10.0, 8  # power over that of the noise; parts of a recording whose spectra are averaged


def with_bandwidth(signals: Signals, overrides: Overrides) -> Signals:
    """The signals with a bandwidth of the position loop: that of the description, of the tracking, or of a given cut-off.

    Raises `IdentificationError` if there is none; it proposes a cut-off.
    """
    robot = signals.robot
    if robot.controller.bandwidth_hz is not None:
        return signals
    cutoff_hz = robot.identification.cutoff_hz if overrides.cutoff_hz is None else overrides.cutoff_hz
    bandwidth_hz, deviation = tracking_bandwidth(signals) if signals.q_ref is not None else (0.0, np.inf)
    source = f"estimated as {bandwidth_hz:.3g} Hz from the tracking of the reference"
    if deviation > MAX_DEVIATION:
        if not cutoff_hz:
            why = f"the tracking gives it to ±{100 * deviation:.2g} % only; " if np.isfinite(deviation) else ""
            expected = f"{why}the bandwidth of the position loop in Hz, or --cutoff-hz {motion_hz(signals):.2g}"
            raise IdentificationError(
                place=f"robot {robot.name}",
                key="controller.bandwidth_hz",
                value=None,
                expected=f"{expected}, above which {signals.recording} has only noise",
            )
        bandwidth_hz = cutoff_hz / CUTOFF_PER_BANDWIDTH
        source = f"taken as {bandwidth_hz:.3g} Hz, a fifth of the cut-off"
    controller = msgspec.structs.replace(robot.controller, bandwidth_hz=bandwidth_hz)
    assumed = f"controller.bandwidth_hz is not stated: {source}; filters and the simulated loop depend on it"
    return replace(signals, robot=replace(robot, controller=controller), assumed=(assumed,))


def tracking_bandwidth(signals: Signals) -> tuple[float, float]:
    """w_n / 2 pi in Hz of the slowest loop from q_ref to q, and its relative deviation, infinite if no joint has one.

    A PD at joint j, with or without feed-forward of speed (phi) and gravity, follows with the error

        q_ref - q = IDM_j(q, dq, ddq) beta / Kp + (2 zeta / w_n) (dq - phi dq_ref)

    so the model's rows, fitted to this error in place of the torque, give the inertia J_j / Kp = 1 / w_n², and zeta.
    Instruments are the rows of the reference, which has no noise.
    """
    assert signals.q_ref is not None
    fs, stop, n = signals.sample_rate_hz, min(len(signals.q), _SAMPLES), signals.robot.n
    cutoff_hz = min(_CUTOFF_HZ, _CUTOFF_SHARE * fs)
    border = int(3 * fs / cutoff_hz)
    at = slice(border, stop - border, max(1, stop // _ROWS))
    derivatives = list[list[Array]]()
    for x in (signals.q, signals.q_ref):
        x = lowpass(np.array(x[:stop]), cutoff_hz, fs)
        dx, ddx = (differentiate(x, fs), differentiate(differentiate(x, fs), fs))
        derivatives.append([x[at], dx[at], ddx[at], differentiate(ddx, fs)[at]])
    (q, dq, ddq, _), (q_ref, dq_ref, ddq_ref, jerk_ref) = derivatives
    model, one = InverseModel(signals.robot), np.ones((len(q), 1))
    columns, poses = base_parameters(model).columns, poses_of(q)
    W, Z = model.regressor(q, dq, ddq)[..., columns], model.regressor(q_ref, dq_ref, ddq_ref)[..., columns]
    still = np.zeros_like(poses)
    weight = model.regressor(poses, still, still)[..., columns]
    best, reliable = (0.0, np.inf), list[tuple[float, float]]()
    for j in range(n):
        J = (model.regressor(poses, still, still + np.eye(n)[j])[..., columns] - weight)[:, j].mean(axis=0)
        A, scale = _scaled(np.hstack([W[:, j], dq[:, [j]], dq_ref[:, [j]], one]))
        instruments, _ = _scaled(np.hstack([Z[:, j], dq_ref[:, [j]], jerk_ref[:, [j]], one]))
        inverse = np.linalg.pinv(instruments.T @ A, rcond=_RCOND) @ instruments.T
        e, along = (q_ref - q)[:, j], (np.append(J, [0.0, 0.0, 0.0]) / scale) @ inverse
        share, rho = float(along @ e), e - A @ (inverse @ e)
        if share > 0:
            deviation = 0.5 * float(np.linalg.norm(along) * np.linalg.norm(rho)) / len(rho) ** 0.5 / share
            found = share**-0.5 / (2 * np.pi), deviation
            best = min(best, found, key=lambda pair: pair[1])
            reliable += [found] * (deviation <= MAX_DEVIATION)
    return min(reliable, default=best)


def _scaled(A: Array) -> tuple[Array, Array]:
    """Columns of unit length, and the lengths; columns of zeros stay."""
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0] = 1.0
    return A / scale, scale


def motion_hz(signals: Signals) -> float:
    """The frequency above which no joint's position is more than noise, Hz."""
    fs, N = signals.sample_rate_hz, min(len(signals.q), _SAMPLES) // _SEGMENTS
    parts = np.diff(signals.q[: N * _SEGMENTS].reshape(_SEGMENTS, N, -1), axis=1)
    power = (np.abs(np.fft.rfft(np.hanning(N - 1)[:, None] * parts, axis=1)) ** 2).mean(axis=0)
    f = np.fft.rfftfreq(N - 1, 1 / fs)[1:, None]
    power = power[1:] / np.sin(np.pi * f / fs) ** 2  # of the position: white noise is then level
    floor = np.median(power[f[:, 0] > 0.25 * fs], axis=0)
    above = (power > _FLOOR * floor).any(axis=1)
    return float(f[np.flatnonzero(above).max(initial=0), 0])
