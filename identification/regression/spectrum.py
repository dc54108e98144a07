"""Where a recorded motion ends, and where most of it is, by the spectra of its positions."""

import numpy as np

from ..arrays import Array, Bools
from ..data import Signals
from .motion import STANDSTILL_SPEED, largest_of_type

_SPECTRUM = 200_000  # samples of a recording that show where its motion ends
_SAMPLES = 20_000  # of these, that show where most of it is
BAND = 0.99  # of the power of each joint's speed
# power over that of the noise; parts of a recording whose spectra are averaged
_FLOOR, _SEGMENTS = 10.0, 8


def motion_end_hz(signals: Signals) -> float:
    """The frequency above which no joint's position is more than noise, Hz."""
    fs, N = signals.sample_rate_hz, min(len(signals.q), _SPECTRUM) // _SEGMENTS
    if N < 3:  # no spectrum: the settings refuse so short a recording
        return fs
    parts = np.diff(signals.q[: N * _SEGMENTS].reshape(_SEGMENTS, N, -1), axis=1)
    power = (np.abs(np.fft.rfft(np.hanning(N - 1)[:, None] * parts, axis=1)) ** 2).mean(axis=0)
    f = np.asarray(np.fft.rfftfreq(N - 1)[1:], dtype=float)
    above = _above_noise(power[1:], f).any(axis=1)
    return float(fs * f[np.flatnonzero(above).max(initial=0)])


def motion_band_hz(signals: Signals) -> float:
    """The frequency below which nearly all power of each joint's speed lies, Hz, without noise and
    joints that stand.
    """
    stride = max(1, min(len(signals.q), _SPECTRUM) // _SAMPLES)
    steps = np.diff(signals.q[:_SPECTRUM:stride], axis=0)
    power = np.abs(np.fft.rfft(np.hanning(len(steps))[:, None] * steps, axis=0))[1:] ** 2
    f = np.arange(1, len(power) + 1) * signals.sample_rate_hz / (stride * max(1, len(steps)))
    if not len(f):
        return signals.sample_rate_hz
    power = np.where(_above_noise(power, f * stride / signals.sample_rate_hz), power, 0.0)
    size, joints = power.sum(axis=0), signals.robot.joints
    # without joints that stand, as in `standing_joints`: what is left of them is noise
    moves = size > STANDSTILL_SPEED**2 * largest_of_type(size, joints)
    below = np.cumsum(power[:, moves], axis=0) < BAND * size[moves]
    return float(f[min(int(below.sum(axis=0).max(initial=0)), len(f) - 1)])


def _above_noise(power: Array, f: Array) -> Bools:
    """Where spectra (F, n) of steps of the position are above white noise of the position, which is
    told by the upper half of the frequencies f (F,), in parts of the rate.
    """
    of_position = power / np.sin(np.pi * f[:, None]) ** 2
    return np.asarray(of_position > _FLOOR * np.median(of_position[f > 0.25], axis=0))
