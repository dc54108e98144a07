"""Joint motion and torque on one time grid; the low-passed motion of a recording.

Before a fit the recording itself shows the time range that is used, without the samples that
filters distort at its ends; the band of its motion, by the spectra of its positions; and prior
knowledge of the delay of its torque.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Any, Literal, TypeVar, cast

import numpy as np

from acquisition.errors import NoFitError
from acquisition.files import release_pages
from acquisition.robot import Joint

from ..arrays import Array, Bools, Ints
from ..data import Signals
from ..estimation import MOVING
from ..options import Overrides, Span
from .filtering import lowpass, lowpass_reach

BLOCK_SAMPLES = 200_000  # samples of a recording that are processed at a time
SPLINE_REACH = 40  # samples after which the end of a cubic spline has no influence
_DIFFERENCES = 2  # samples to each side that two central differences need
# Numbers of a filtered position, 32 MB; a longer recording is filtered again in each iteration.
_MAX_NUMBERS = 4_000_000

# Share of the peak speed of the fastest joint; a joint that is always slower shows only noise.
STANDSTILL_SPEED = 0.01
CUT_PERIODS = 5.0  # of the cut-off that are cut at a border: 50 samples at 1 kHz and 100 Hz
MIN_ROWS = 30  # decimated rows of a fit
SpanKind = Literal["all", "track", "motion"]
SPANS: dict[SpanKind, str] = {
    "all": "all samples",
    "track": "the recording's tracking phase",
    "motion": "from first to last motion",
}
_SPECTRUM = 200_000  # samples whose spectrum shows at which frequency the motion ends
_SAMPLES = 20_000  # samples, of these, that show the band of the motion
BAND = 0.99  # share of the power of each joint's speed
# Power of motion over that of noise; parts of a recording whose spectra are averaged.
_FLOOR, _SEGMENTS = 10.0, 8
LAG_REACH = 3.0  # standard deviations that a likely delay differs from the prior one
NOTHING, UNKNOWN_LAG_S = "nothing", 0.002  # source and standard deviation of an unknown delay

Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Joint motion and torque on one uniform grid.

    Attributes:
        t_s: (N,) time, s.
        q, dq, ddq: (N, n) position, speed and acceleration, rad or m, per s, per s².
        tau: (N, n) torque, N m or N.
    """

    t_s: Array
    q: Array
    dq: Array
    ddq: Array
    tau: Array

    def __post_init__(self) -> None:
        for array in (self.q, self.dq, self.ddq, self.tau):
            array.flags.writeable = False

    def part(self, at: slice) -> "Motion":
        """Return the motion of the samples `at`."""
        return Motion(
            t_s=self.t_s[at], q=self.q[at], dq=self.dq[at], ddq=self.ddq[at], tau=self.tau[at]
        )


class FilteredMotion:
    """Motion of a recording at any cut-off, or of other positions (N, n) with its torque.

    Each cut-off is filtered once, unless the recording is long. Results computed from it are kept
    too.
    """

    def __init__(self, signals: Signals, q: Array | None = None) -> None:
        """Store the signals; positions `q` (N, n) replace the recorded ones."""
        self._signals, self._q = signals, signals.q if q is None else q
        self._made: dict[object, Any] = {}

    def once(self, key: object, make: Callable[[], Made]) -> Made:
        """Return what `make` returns, computed once.

        `key` identifies the result, with the settings that it depends on.
        """
        if key not in self._made:
            self._made[key] = make()
        return cast(Made, self._made[key])

    def between(self, start: int, stop: int, cutoff_hz: float | None) -> Motion:
        """Return the motion of the samples `start` to `stop`, without low-pass for None."""
        s, q, fs = self._signals, self._q, self._signals.sample_rate_hz
        if cutoff_hz is not None and q.size <= _MAX_NUMBERS:
            q, cutoff_hz = (
                self.once(("low-passed", cutoff_hz), partial(lowpass, q, cutoff_hz, fs)),
                None,
            )
        motion = motion_between(
            q, s.torque, cutoff_hz=cutoff_hz, sample_rate_hz=fs, start=start, stop=stop
        )
        if q is self._q:
            release_pages(q)
            release_pages(s.torque)
        return motion


def differentiate(x: Array, sample_rate_hz: float) -> Array:
    """Return central differences of x along axis 0, one-sided at the two ends.

    They have no phase shift.
    """
    return np.asarray(np.gradient(x, 1.0 / sample_rate_hz, axis=0))


def sampled_at(at: Array, x: Array) -> Array:
    """Interpolate x (N, n) at places `at` (K,) in samples, by a cubic spline.

    Places may be fractions, such as 1.5. Beyond the ends, the end samples are used.
    """
    at = np.clip(at, 0, len(x) - 1)
    picks = np.rint(at).astype(np.intp)
    if np.abs(at - picks).max() < 1e-6:
        return x[picks]
    i = at.astype(np.intp)
    return on_spline(i, (at - i)[:, None], spline_coefficients(x))


def on_spline(i: Ints, u: Array, c: Array) -> Array:
    """Evaluate a cubic spline.

    Parameters
    ----------
    i : (K,) samples before the places.
    u : () or (K, 1) places after these samples, 0 to 1.
    c : (N + 3, n) coefficients, as returned by `spline_coefficients`.
    """
    return np.asarray(sum(w * c.take(i + k, axis=0) for k, w in enumerate(_spline_weights(u))))


def _spline_weights(u: Array) -> list[Array]:
    """Return the weights of four coefficients, by the place from 0 to 1 between samples."""
    v, uu = 1 - u, u * u  # products, because a power of 3 takes four times as long
    vv = v * v
    return [w / 6 for w in (vv * v, 4 - 3 * uu * (1 + v), 4 - 3 * vv * (1 + u), uu * u)]


def spline_coefficients(x: Array) -> Array:
    """Return coefficients (N + 3, n) of the cubic B-splines that go through x (N, n).

    The splines are centred at the samples -1 to N + 1. Unser, Aldroubi, Eden, IEEE Trans. Signal
    Processing 41 (1993): the inverse of the filter (1, 4, 1)/6 decays by the pole 2 - sqrt(3) per
    sample, to rounding within `SPLINE_REACH`. It is 1/(1 - pole B) forward and backward, with B the
    sample before, and is computed as

        (1 + pole B) (1 + pole² B²) (1 + pole⁴ B⁴) ...

    Beyond the ends x is reflected at its end samples.
    """
    pole, beyond = np.sqrt(3.0) - 2.0, SPLINE_REACH + 2
    c = np.pad(x, ((beyond, beyond), (0, 0)), mode="reflect", reflect_type="odd")
    for way, k in product((c, c[::-1]), 2 ** np.arange(SPLINE_REACH.bit_length())):
        way[k:] += pole**k * way[:-k]
    return np.asarray(np.sqrt(3.0) * (1 - pole**2) * c[beyond - 1 : beyond + 2 + len(x)])


def smooth(f: Callable[..., Array], motion: Motion, stride: int) -> Array:
    """Compute f(q, dq, ddq) (N, ...) at every `stride`-th sample, on a cubic spline between them.

    Parameters
    ----------
    f : function of q, dq, ddq (K, n).
    motion : a smooth, that is, low-passed motion of N samples.
    stride : samples from one evaluation to the next.
    """
    stride = max(1, stride)
    last = (len(motion.q) - 1) // stride * stride
    if stride == 1 or last == 0:
        return f(motion.q, motion.dq, motion.ddq)
    at = np.r_[0:last:stride, last : len(motion.q)]
    x, count = f(motion.q[at], motion.dq[at], motion.ddq[at]), last // stride
    series = x.reshape(len(at), -1)
    c = np.ascontiguousarray(spline_coefficients(series[: count + 1]).T)
    knots = np.stack([c[:, k : k + count] for k in range(4)], axis=2)
    between = knots @ np.array(_spline_weights(np.arange(stride) / stride))
    found = np.concatenate([between.reshape(len(c), last), series[count:].T], axis=1)
    return found.T.reshape(len(motion.q), *x.shape[1:])


def motion_between(
    q: Array, tau: Array, *, cutoff_hz: float | None, sample_rate_hz: float, start: int, stop: int
) -> Motion:
    """Return the filtered motion of some samples.

    Only the samples that affect them are filtered, so blocks give the same result as the whole.

    Parameters
    ----------
    q, tau : (N, n) positions, rad or m, and torques, N m or N.
    cutoff_hz : cut-off of the low-pass, Hz; None for no low-pass.
    sample_rate_hz : sample rate, Hz.
    start, stop : first sample, and the one after the last.
    """
    margin = _DIFFERENCES + (lowpass_reach(cutoff_hz, sample_rate_hz) if cutoff_hz else 0)
    low, high = max(0, start - margin), min(len(q), stop + margin)
    part, inside = q[low:high], slice(start - low, stop - low)
    if cutoff_hz:
        part = lowpass(part, cutoff_hz, sample_rate_hz)
    dq = differentiate(part, sample_rate_hz)
    return Motion(
        t_s=np.arange(start, stop) / sample_rate_hz,
        q=np.array(part[inside]),
        dq=dq[inside],
        ddq=differentiate(dq, sample_rate_hz)[inside],
        tau=np.array(tau[start:stop]),
    )


def largest_of_type(values: Array, joints: Sequence[Joint]) -> Array:
    """Return the largest of the `values` (n,) of joints of the same type, (n,).

    If that is zero, it is the largest of all joints.
    """
    types = np.array([joint.type for joint in joints])
    found = np.array([values[types == of].max() for of in types])
    return np.where(found > 0, found, values.max())


def standing_joints(peak: Array, joints: Sequence[Joint]) -> tuple[str, ...]:
    """Return the joints that do not move, by their `peak` speeds (n,).

    They are slow compared with the fastest joint of the same type.
    """
    limits = STANDSTILL_SPEED * largest_of_type(peak, joints)
    return tuple(
        joint.name for joint, stands in zip(joints, ~(peak > limits), strict=True) if stands
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Lag:
    """The delay of the torque of a recording, or of several of equal timing, s, positive if late.

    Attributes:
        value_s: delay, s.
        sd_s: standard error of the delay, s, which the intervals include; 0 if the user gave the
            delay.
        source: where the value comes from.
        period_s: sample period, s.
        reach: half-width of the 95 % interval, in standard errors.
        prior: delay by prior knowledge, if data have been combined with it.
        found: value, standard error, and degrees of freedom by the instruments alone; None if they
            do not determine it.
        by_law_s: delay at which the given control law reproduces the effort, s; None without one.
        moved: (b,) change of each parameter by one standard error of the delay.
        recordings: names of the recordings.
        order: order of the filter that whitens the rows of the delay; 0 without such rows.
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
        """True if the user gave the delay."""
        return self.sd_s == 0.0

    @property
    def half_width_s(self) -> float:
        """Half-width of its 95 % interval, s."""
        return self.reach * self.sd_s

    @property
    def delay_s(self) -> tuple[float, float] | None:
        """Time from command to torque and its half-width, s; None without a given control law."""
        if self.by_law_s is None or self.found is None:
            return None
        return self.by_law_s - self.found[0], self.reach * self.found[1]

    def with_other(self, other: "Lag") -> "Lag":
        """Combine both delays, weighted by their variances."""
        own, others = self.sd_s**-2, other.sd_s**-2
        return replace(
            self,
            value_s=(own * self.value_s + others * other.value_s) / (own + others),
            sd_s=(own + others) ** -0.5,
            source=f"{self.source} and {other.source}",
        )


def known_lag(signals: Signals, overrides: Overrides) -> Lag:
    """Return the delay of a recording's torque by prior knowledge.

    A command that is held for a control period is half that period early: it is recorded at the
    tick and acts, on average, half a period later. If no control period is given, it is the sample
    period. "none" specifies a delay of 0.
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
    """Return the kind of the time range, its first and last sample, and the joints at rest.

    `cutoff_hz` separates motion from noise. Joints at rest are determined only for the kind
    `motion`.
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
            "no joint moves",
            place=signals.recording,
            advice="Record an exciting trajectory; `robot-identify excite` designs one",
        )
    standing = standing_joints(peak, signals.robot.joints)
    moves = [joint.name not in standing for joint in signals.robot.joints]
    moving = np.flatnonzero((speed > MOVING * peak)[:, moves].any(axis=1))
    return "motion", (int(moving[0]), int(moving[-1]) + 1), standing


def with_torque(signals: Signals, span: tuple[int, int], lag: Lag) -> range:
    """Return the samples of a time range whose torque is recorded at every likely delay.

    Cuts that the description gives are removed too.
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
    """Return the samples that the low-pass does not distort; given cuts replace its border.

    `span` is the time range in words, for the error.

    Raises
    ------
    NoFitError : too few samples are left for `decimation`.
    """
    stored, border = signals.robot.identification, border_samples(cutoff_hz, signals.sample_rate_hz)
    used = range(
        max(widest.start, border if stored.cut_start_samples is None else 0),
        min(widest.stop, len(signals.q) - (border if stored.cut_end_samples is None else 0)),
    )
    if len(used) < MIN_ROWS * decimation:
        raise NoFitError(
            place=signals.recording,
            text=f"{len(used)} samples are left after cutting the borders ({span}), but a fit "
            f"needs {MIN_ROWS * decimation}, for {MIN_ROWS} decimated rows",
            advice="Record longer motion",
        )
    return used


def border_samples(cutoff_hz: float | None, fs: float) -> int:
    """Return the number of samples at an end of a recording that the low-pass distorts."""
    return 2 if cutoff_hz is None else math.ceil(CUT_PERIODS * fs / cutoff_hz)


def motion_end_hz(signals: Signals) -> float:
    """Return the frequency above which no joint's position is more than noise, Hz."""
    fs, N = signals.sample_rate_hz, min(len(signals.q), _SPECTRUM) // _SEGMENTS
    # So short a recording has no spectrum; the settings refuse it later.
    if N < 3:
        return fs
    parts = np.diff(signals.q[: N * _SEGMENTS].reshape(_SEGMENTS, N, -1), axis=1)
    power = (np.abs(np.fft.rfft(np.hanning(N - 1)[:, None] * parts, axis=1)) ** 2).mean(axis=0)
    f = np.asarray(np.fft.rfftfreq(N - 1)[1:], dtype=float)
    above = np.flatnonzero(_above_noise(power[1:], f).any(axis=1))
    return float(fs * f[above.max(initial=0)])


def motion_band_hz(signals: Signals) -> float:
    """Return the frequency below which nearly all power of each joint's speed lies, Hz.

    Noise and joints at rest do not count.
    """
    stride = max(1, min(len(signals.q), _SPECTRUM) // _SAMPLES)
    steps = np.diff(signals.q[:_SPECTRUM:stride], axis=0)
    power = np.abs(np.fft.rfft(np.hanning(len(steps))[:, None] * steps, axis=0))[1:] ** 2
    f = np.arange(1, len(power) + 1) * signals.sample_rate_hz / (stride * max(1, len(steps)))
    if not len(f):
        return signals.sample_rate_hz
    power = np.where(_above_noise(power, f * stride / signals.sample_rate_hz), power, 0.0)
    size, joints = power.sum(axis=0), signals.robot.joints
    # Joints at rest do not count, as in `standing_joints`, because their spectrum is noise.
    moves = size > STANDSTILL_SPEED**2 * largest_of_type(size, joints)
    below = np.cumsum(power[:, moves], axis=0) < BAND * size[moves]
    return float(f[min(int(below.sum(axis=0).max(initial=0)), len(f) - 1)])


def _above_noise(power: Array, f: Array) -> Bools:
    """Return a mask of spectra (F, n) of position steps above white noise of the position.

    The upper half of the frequencies f (F,), as shares of the sample rate, shows that noise.
    """
    of_position = power / np.sin(np.pi * f[:, None]) ** 2
    return np.asarray(of_position > _FLOOR * np.median(of_position[f > 0.25], axis=0))
