"""What is known of a recording before its fit: the span of samples that is used, without what
filters distort at the ends, the band of its motion, by the spectra of its positions, and the lag of
the recorded torque.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from acquisition.errors import NoFitError

from ..arrays import Array, Bools
from ..data import Signals
from ..estimation import MOVING
from ..options import Overrides, Span
from .motion import (
    BLOCK_SAMPLES,
    STANDSTILL_SPEED,
    FilteredMotion,
    largest_of_type,
    standing_joints,
)

CUT_PERIODS = 5.0  # border of 5 periods of the cut-off: 50 samples at 1 kHz and 100 Hz
MIN_ROWS = 30  # decimated, of a fit
SpanKind = Literal["all", "track", "motion"]
SPANS: dict[SpanKind, str] = {
    "all": "all samples",
    "track": "the recording's tracking phase",
    "motion": "the span between first and last motion",
}
_SPECTRUM = 200_000  # samples of a recording that show where its motion ends
_SAMPLES = 20_000  # of these, that show where most of it is
BAND = 0.99  # of the power of each joint's speed
# power over that of the noise; parts of a recording whose spectra are averaged
_FLOOR, _SEGMENTS = 10.0, 8
LAG_REACH = 3.0  # deviations that the lag may differ from the known one
NOTHING, UNKNOWN_LAG_S = "nothing", 0.002  # deviation of an unknown lag


@dataclass(frozen=True, kw_only=True, eq=False)
class Lag:
    """The lag of the torque of a recording, or of several of equal timing, s, positive: late.

    Attributes:
        value_s, sd_s: the lag and its deviation, which the intervals include; half a 95 % interval
            is `reach` deviations. A value stated by the user has no deviation.
        source: where the value comes from.
        period_s: of the samples.
        prior: the lag as known without a fit, if data have been combined with it.
        found: value, deviation and its degrees of freedom by the instruments alone; None where
            they do not determine it.
        by_law_s: the lag where the described control law gives the effort, else None.
        moved: (b,) shift of each parameter by one deviation of the lag.
        recordings: their names.
        order: of the filter that whitens the rows of the lag; 0 without such rows.
    """

    value_s: float
    sd_s: float
    source: str
    period_s: float
    reach: float = 2.0
    prior: "Lag | None" = None
    found: tuple[float, float, int] | None = None
    by_law_s: float | None = None
    moved: Array = field(default_factory=lambda: np.zeros(0))
    recordings: tuple[str, ...] = ()
    order: int = 0

    @property
    def stated(self) -> bool:
        """Whether the user stated it."""
        return self.sd_s == 0.0

    @property
    def half_width_s(self) -> float:
        """Half its 95 % interval."""
        return self.reach * self.sd_s

    @property
    def delay_s(self) -> tuple[float, float] | None:
        """Time from command to torque and half its interval; None without a described law."""
        if self.by_law_s is None or self.found is None:
            return None
        return self.by_law_s - self.found[0], self.reach * self.found[1]

    def with_other(self, other: "Lag") -> "Lag":
        """Both combined, weighted by their variances."""
        own, others = self.sd_s**-2, other.sd_s**-2
        return replace(
            self,
            value_s=(own * self.value_s + others * other.value_s) / (own + others),
            sd_s=(own + others) ** -0.5,
            source=f"{self.source} and {other.source}",
        )


def known_lag(signals: Signals, overrides: Overrides) -> Lag:
    """Return the lag of a recording's torque as known without a fit: the value at which the lag
    among the unknowns starts, and its deviation.

    A command held for a control period is half that period early: it is recorded at the tick and
    acts, on average, half a period later. Without a described period it is that of the samples.
    `"none"` states a lag of 0.
    """
    stored = signals.robot.identification
    given = stored.torque_lag_s if overrides.torque_lag_s is None else overrides.torque_lag_s
    if given is not None:
        value_s, sd_s, source = 0.0 if given == "none" else given, 0.0, "torque_lag_s"
    elif signals.effort_timing == "unknown":
        value_s, sd_s, source = 0.0, UNKNOWN_LAG_S, NOTHING
    else:
        held_s = 1 / (signals.robot.controller.sample_rate_hz or signals.sample_rate_hz)
        value_s = -0.5 * held_s if signals.effort_timing == "command" else 0.0
        sd_s, source = 0.25 * held_s, f"effort_timing {signals.effort_timing}"
    return Lag(value_s=value_s, sd_s=sd_s, source=source, period_s=1 / signals.sample_rate_hz)


def find_span(
    signals: Signals, motion: FilteredMotion, cutoff_hz: float, wanted: Span
) -> tuple[SpanKind, tuple[int, int], tuple[str, ...]]:
    """Kind of the span, its first and last sample, and standing joints, if these are determined.

    `cutoff_hz` separates motion from noise.
    """
    N = len(signals.q)
    if wanted == "all":
        return "all", (0, N), ()
    if signals.track is not None:
        return "track", signals.track, ()
    speed = np.empty(signals.q.shape, dtype=np.float32)
    for a in range(0, N, BLOCK_SAMPLES):
        b = min(N, a + BLOCK_SAMPLES)
        speed[a:b] = np.abs(motion.between(a, b, cutoff_hz).dq)
    peak = speed.max(axis=0)
    if not peak.any():
        raise NoFitError(
            "no joint moves", place=signals.recording, expected="an exciting trajectory"
        )
    standing = standing_joints(peak, signals.robot.joints)
    moves = [joint.name not in standing for joint in signals.robot.joints]
    moving = np.flatnonzero((speed > MOVING * peak)[:, moves].any(axis=1))
    return "motion", (int(moving[0]), int(moving[-1]) + 1), standing


def with_torque(signals: Signals, span: tuple[int, int], lag: Lag) -> range:
    """The samples of a span that no stated cut takes, and whose torque is recorded at any likely
    lag.
    """
    fs, N, stored = signals.sample_rate_hz, len(signals.q), signals.robot.identification
    early, late = (fs * (lag.value_s + way * LAG_REACH * lag.sd_s) for way in (-1, 1))
    return range(
        max(span[0], stored.cut_start_samples or 0, math.ceil(-early)),
        min(span[1], N - (stored.cut_end_samples or 0), N - math.ceil(late)),
    )


def inside_borders(
    signals: Signals, widest: range, cutoff_hz: float | None, decimation: int, span: str
) -> range:
    """The samples that the low-pass does not distort, where no cut is stated. If they are too few
    for `decimation`, the error has the span in words.
    """
    stored, border = signals.robot.identification, border_samples(cutoff_hz, signals.sample_rate_hz)
    used = range(
        max(widest.start, border if stored.cut_start_samples is None else 0),
        min(widest.stop, len(signals.q) - (border if stored.cut_end_samples is None else 0)),
    )
    if len(used) < MIN_ROWS * decimation:
        raise NoFitError(
            place=signals.recording,
            key=f"samples left after cutting the borders ({span})",
            value=len(used),
            expected=f"at least {MIN_ROWS * decimation}, {MIN_ROWS} decimated rows",
        )
    return used


def border_samples(cutoff_hz: float | None, fs: float) -> int:
    """Samples at an end of a recording that the low-pass distorts."""
    return 2 if cutoff_hz is None else math.ceil(CUT_PERIODS * fs / cutoff_hz)


def motion_end_hz(signals: Signals) -> float:
    """The frequency above which no joint's position is more than noise, Hz."""
    fs, N = signals.sample_rate_hz, min(len(signals.q), _SPECTRUM) // _SEGMENTS
    if N < 3:  # no spectrum: the settings refuse so short a recording
        return fs
    parts = np.diff(signals.q[: N * _SEGMENTS].reshape(_SEGMENTS, N, -1), axis=1)
    power = (np.abs(np.fft.rfft(np.hanning(N - 1)[:, None] * parts, axis=1)) ** 2).mean(axis=0)
    f = np.asarray(np.fft.rfftfreq(N - 1)[1:], dtype=float)
    above = np.flatnonzero(_above_noise(power[1:], f).any(axis=1))
    return float(fs * f[above.max(initial=0)])


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
