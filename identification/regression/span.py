"""The samples of a recording that are used: a span, without what filters distort at the ends."""

import math
from typing import Literal

import numpy as np

from acquisition.errors import NoFitError

from ..data import Signals
from ..estimation import MOVING
from ..options import Span
from .known_lag import LAG_REACH, Lag
from .motion import BLOCK_SAMPLES, FilteredMotion, standing_joints

CUT_PERIODS = 5.0  # border of 5 periods of the cut-off: 50 samples at 1 kHz and 100 Hz
MIN_ROWS = 30  # decimated, of a fit
SpanKind = Literal["all", "track", "motion"]
SPANS: dict[SpanKind, str] = {
    "all": "all samples",
    "track": "the recording's tracking phase",
    "motion": "the span between first and last motion",
}


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
    signals: Signals, widest: range, cutoff_hz: float | None, told: tuple[int, str]
) -> range:
    """The samples that the low-pass does not distort, where no cut is stated. What is `told` if
    they are too few: samples of a row, and the span in words.
    """
    stored, border = signals.robot.identification, border_samples(cutoff_hz, signals.sample_rate_hz)
    used = range(
        max(widest.start, border if stored.cut_start_samples is None else 0),
        min(widest.stop, len(signals.q) - (border if stored.cut_end_samples is None else 0)),
    )
    decimation, span = told
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
