"""Joint motion and torque on one time grid; the low-passed motion of a recording."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, TypeVar

import numpy as np

from acquisition.files import release_pages
from acquisition.robot import Joint

from ..arrays import Array, Ints
from ..data import Signals
from .filtering import lowpass, lowpass_reach

BLOCK_SAMPLES = 200_000  # of a recording that are processed at a time
SPLINE_REACH = 40  # samples beyond which the end of a cubic spline has no influence
_DIFFERENCES = 2  # samples to each side that two central differences reach
# of a filtered position, 32 MB; a longer recording is filtered again in each pass
_MAX_NUMBERS = 4_000_000

# of the peak speed of the fastest joint: a joint that never exceeds it shows only noise
STANDSTILL_SPEED = 0.01

Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Joint motion and torque on one uniform grid: t_s (N,), q, dq, ddq, tau (N, n);
    rad or m, s, N m or N.
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
        """The samples `at` of it."""
        return Motion(
            t_s=self.t_s[at], q=self.q[at], dq=self.dq[at], ddq=self.ddq[at], tau=self.tau[at]
        )


class FilteredMotion:
    """Motion of a recording, or other positions (N, n) with its torque, at any cut-off; each
    cut-off is filtered once, unless the recording is long. It keeps what others make of it.
    """

    def __init__(self, signals: Signals, q: Array | None = None) -> None:
        """`q` (N, n): other positions than the recorded ones."""
        self._signals, self._q = signals, signals.q if q is None else q
        self._made: dict[object, Any] = {}

    def once(self, key: object, make: Callable[[], Made]) -> Made:
        """What is made of this motion, made once; `key`: what it is, and its settings."""
        if key not in self._made:
            self._made[key] = make()
        found: Made = self._made[key]
        return found

    def between(self, start: int, stop: int, cutoff_hz: float | None) -> Motion:
        """Motion of the samples `start` to `stop`; `cutoff_hz` None: no low-pass."""
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
    """Central differences along axis 0 (no phase shift), one-sided at the two ends."""
    return np.asarray(np.gradient(x, 1.0 / sample_rate_hz, axis=0))


def sampled_at(at: Array, x: Array) -> Array:
    """Samples x (N, n) at places (K,) counted in samples, such as 1.5: cubic spline between
    samples, no phase shift.

    Beyond the ends, the end samples are used.
    """
    at = np.clip(at, 0, len(x) - 1)
    picks = np.rint(at).astype(np.intp)
    if np.abs(at - picks).max() < 1e-6:
        return x[picks]
    i = at.astype(np.intp)
    return on_spline(i, (at - i)[:, None], spline_coefficients(x))


def on_spline(i: Ints, u: Array, c: Array) -> Array:
    """The cubic spline of coefficients c (N + 3, n) at u, 0 to 1, behind the samples i (K,); u is
    () or (K, 1).
    """
    return np.asarray(sum(w * c.take(i + k, axis=0) for k, w in enumerate(_spline_weights(u))))


def _spline_weights(u: Array) -> list[Array]:
    """Of four coefficients, by the place from 0 to 1 between samples."""
    v, uu = 1 - u, u * u  # a power of 3 takes four times as long as products
    vv = v * v
    return [w / 6 for w in (vv * v, 4 - 3 * uu * (1 + v), 4 - 3 * vv * (1 + u), uu * u)]


def spline_coefficients(x: Array) -> Array:
    """Coefficients (N + 3, n) of the cubic B-splines about the samples -1 to N + 1
    that go through x (N, n).

    Unser, Aldroubi, Eden, IEEE Trans. Signal Processing 41 (1993): the inverse of the filter (1, 4,
    1)/6 falls by the pole 2 - sqrt(3) from sample to sample, to rounding within `SPLINE_REACH`. It
    is 1/(1 - pole B), B the sample before, and the same backward; each as (1 + pole B)
    (1 + pole² B²) (1 + pole⁴ B⁴) and so on. Beyond the ends x is reflected at its end samples.
    """
    pole, beyond = np.sqrt(3.0) - 2.0, SPLINE_REACH + 2
    c = np.pad(x, ((beyond, beyond), (0, 0)), mode="reflect", reflect_type="odd")
    for way, k in product((c, c[::-1]), 2 ** np.arange(SPLINE_REACH.bit_length())):
        way[k:] += pole**k * way[:-k]
    return np.asarray(np.sqrt(3.0) * (1 - pole**2) * c[beyond - 1 : beyond + 2 + len(x)])


def smooth(f: Callable[..., Array], motion: Motion, stride: int) -> Array:
    """f(q, dq, ddq) (N, ...) along a smooth motion: computed at every `stride`-th sample, on a
    cubic spline between them.
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
    """Filtered motion of the samples `start` to `stop` of q, tau (N, n).

    `cutoff_hz` None: no low-pass. Beyond the range only the samples that influence it are filtered:
    blocks give the same result as one pass.
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
    """(n,) largest of the `values` (n,) of joints of the same type, or of all
    joints where that is zero.
    """
    types = np.array([joint.type for joint in joints])
    found = np.array([values[types == of].max() for of in types])
    return np.where(found > 0, found, values.max())


def standing_joints(peak: Array, joints: Sequence[Joint]) -> tuple[str, ...]:
    """Names of the joints whose `peak` speeds (n,) are small compared with that of the fastest
    joint of the same type.
    """
    limits = STANDSTILL_SPEED * largest_of_type(peak, joints)
    return tuple(
        joint.name for joint, stands in zip(joints, ~(peak > limits), strict=True) if stands
    )
