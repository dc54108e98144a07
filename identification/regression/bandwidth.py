"""A position loop whose bandwidth the description does not state: low-pass and simulated loop end
where the motion does.
"""

from dataclasses import replace

import msgspec
import numpy as np

from ..data import Signals
from .settings import MAX_CUTOFF_SHARE

# of a simulated loop; one at its end itself lags: friction holds a UR5's wrist back by 30 %
LOOP_PER_MOTION = 2.0
_SAMPLES = 200_000  # most of a recording
# power over that of the noise; parts of a recording whose spectra are averaged
_FLOOR, _SEGMENTS = 10.0, 8


def with_bandwidth(signals: Signals) -> Signals:
    """The signals with a bandwidth of the position loop: that of the description, or one that
    follows the recorded motion.

    The tracking of the reference does not show it: with speed fed forward the position follows
    without an error, and a reference recorded some milliseconds early has one without a loop.
    """
    robot, fs = signals.robot, signals.sample_rate_hz
    if robot.controller.bandwidth_hz is not None:
        return signals
    hz = min(motion_hz(signals), MAX_CUTOFF_SHARE * fs)
    controller = msgspec.structs.replace(robot.controller, bandwidth_hz=LOOP_PER_MOTION * hz)
    return replace(signals, robot=replace(robot, controller=controller), motion_hz=hz)


def motion_hz(signals: Signals) -> float:
    """The frequency above which no joint's position is more than noise, Hz."""
    fs, N = signals.sample_rate_hz, min(len(signals.q), _SAMPLES) // _SEGMENTS
    if N < 3:  # no spectrum: the settings refuse so short a recording
        return fs
    parts = np.diff(signals.q[: N * _SEGMENTS].reshape(_SEGMENTS, N, -1), axis=1)
    power = (np.abs(np.fft.rfft(np.hanning(N - 1)[:, None] * parts, axis=1)) ** 2).mean(axis=0)
    f = np.fft.rfftfreq(N - 1, 1 / fs)[1:, None]
    power = power[1:] / np.sin(np.pi * f / fs) ** 2  # of the position: white noise is then level
    floor = np.median(power[f[:, 0] > 0.25 * fs], axis=0)
    above = (power > _FLOOR * floor).any(axis=1)
    return float(f[np.flatnonzero(above).max(initial=0), 0])
