"""Zero-phase low-pass, central differences, parallel decimation.

The low-pass pads by three times the filter's order, as MATLAB's filtfilt does, and decimation keeps the last sample, as its
decimate does. Decimation smooths the ends; MATLAB's own edge rule, on which published digits rest, is there on request.
`scipy.signal` takes half a second to import: it is imported where a filter is designed or run.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError

BUTTERWORTH_ORDER = 4
CHEBYSHEV_ORDER = 8
CHEBYSHEV_RIPPLE_DB = 0.05
END_REACH = 150  # samples per unit of the factor in which the decimation filter's ringing dies away
LARGEST_PASS = 13  # a decimation by more goes in several passes
_DIFFERENCES = 2  # samples to each side that two central differences reach


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Joint motion and torque on one uniform grid: t_s (N,), q, dq, ddq, tau (N, n); rad or m, s, N m or N."""

    t_s: Array
    q: Array
    dq: Array
    ddq: Array
    tau: Array

    def __post_init__(self) -> None:
        for array in (self.q, self.dq, self.ddq, self.tau):
            if array.shape != self.q.shape or len(array) != len(self.t_s):
                raise ValueError(f"shapes do not agree: {array.shape}, {self.q.shape}, {self.t_s.shape}")
            array.flags.writeable = False


def lowpass(x: Array, cutoff_hz: float, sample_rate_hz: float) -> Array:
    """Butterworth of order 4, forward and backward, along axis 0 (time).

    `cutoff_hz` is the -3 dB frequency of the filter in one direction, as in `butter` and `filtfilt` of MATLAB and in the
    papers; forward and backward together it is -6 dB there, and -3 dB at `forward_backward_3db_hz`.
    """
    if not 0 < cutoff_hz < sample_rate_hz / 2:
        raise IdentificationError(
            f"cut-off {cutoff_hz:g} Hz: expected between 0 and {sample_rate_hz / 2:g} Hz, half the rate"
        )
    padding = 3 * BUTTERWORTH_ORDER
    if len(x) <= padding:
        raise IdentificationError(f"{len(x)} samples are too few for the filter; expected more than {padding}")
    from scipy import signal

    sos = signal.butter(BUTTERWORTH_ORDER, cutoff_hz, fs=sample_rate_hz, output="sos")
    # Counted from the first sample, a joint that stands still stays at exactly zero: rounding is no motion.
    filtered = signal.sosfiltfilt(sos, np.ascontiguousarray((x - x[0]).T), axis=-1, padlen=padding)
    return np.asarray(np.ascontiguousarray(filtered.T) + x[0])


def forward_backward_3db_hz(cutoff_hz: float, sample_rate_hz: float) -> float:
    """Frequency at which the filter, forward and backward, is down by 3 dB (a factor of sqrt(1/2))."""
    # |H|² of one direction is 1 / (1 + x^2n) with x = tan(pi f / fs) / tan(pi fc / fs); both directions give |H|² as gain.
    x = (np.sqrt(2.0) - 1.0) ** (1 / (2 * BUTTERWORTH_ORDER))
    return float(sample_rate_hz / np.pi * np.arctan(x * np.tan(np.pi * cutoff_hz / sample_rate_hz)))


def differentiate(x: Array, sample_rate_hz: float) -> Array:
    """Central differences along axis 0 (no phase shift), one-sided at the two ends."""
    return np.asarray(np.gradient(x, 1.0 / sample_rate_hz, axis=0))


@dataclass(frozen=True, kw_only=True)
class Decimation:
    """Parallel decimation by `factor`; `smooth_ends` as in `decimate`."""

    factor: int = 1
    smooth_ends: bool = True

    def rows(self, samples: int) -> int:
        """Number of rows that so many samples give."""
        return -(-samples // self.factor)

    def filtered(self, x: Array) -> Array:
        """x decimated along its last axis: low-pass, then every `factor`-th sample."""
        return decimate(x, self.factor, smooth_ends=self.smooth_ends)

    def kept(self, x: Array) -> Array:
        """The samples of x (N, n) at the instants that are kept, unfiltered."""
        return x[(len(x) - 1) % self.factor :: self.factor]


def decimation_passes(factor: int) -> tuple[int, ...]:
    """Factors, each at most 13 where the number allows it, whose product is `factor`: 100 is two passes by 10."""
    if factor == 1:
        return ()
    if factor <= LARGEST_PASS:
        return (factor,)
    divisors = [d for d in range(2, LARGEST_PASS + 1) if factor % d == 0]
    if not divisors:
        return (factor,)
    # The plan with the fewest passes, and of those the most even one: filters of alike, moderate cut-offs.
    plans = [(d, *decimation_passes(factor // d)) for d in divisors]
    return min(plans, key=lambda plan: (max(plan) > LARGEST_PASS, len(plan), max(plan)))


def decimate(x: Array, factor: int, *, smooth_ends: bool = True) -> Array:
    """Parallel decimation along the LAST axis: zero-phase Chebyshev low-pass, then every `factor`-th sample.

    Order 8, 0.05 dB, cut-off 0.8/factor of half the rate; the last sample is kept, as MATLAB's `decimate` does. The
    paper's equation (6): the same filter for the torque and for every column of the regressor.

    The ends are reflected at a line through the last samples, as far as the filter reaches. Without `smooth_ends` they are
    reflected at the end samples themselves, as MATLAB does: the noise of these two stands at full size in the rows beside.
    """
    from scipy import signal

    for r in decimation_passes(factor):
        padding = 3 * CHEBYSHEV_ORDER
        if x.shape[-1] <= padding:
            raise IdentificationError(
                f"{x.shape[-1]} samples are too few to decimate by {r}; expected more than {padding}"
            )
        sos = _chebyshev(r)
        if smooth_ends:
            extended, reach = _extended(x, r)
            filtered = signal.sosfiltfilt(sos, extended, axis=-1, padtype=None, padlen=0)[..., reach:-reach]
        else:
            filtered = signal.sosfiltfilt(sos, x, axis=-1, padlen=padding)
        x = filtered[..., (x.shape[-1] - 1) % r :: r]
    return np.ascontiguousarray(x)


@lru_cache
def _chebyshev(r: int) -> Array:
    """Second order sections of the filter before every r-th sample is kept; its design costs as much as its use."""
    from scipy import signal

    return np.asarray(signal.cheby1(CHEBYSHEV_ORDER, CHEBYSHEV_RIPPLE_DB, 0.8 / r, output="sos"))


def _extended(x: Array, r: int) -> tuple[Array, int]:
    """x with both ends extended by odd reflection at the end of a line fitted to its last 6 r samples; by how many."""
    reach, near = min(END_REACH * r, x.shape[-1] - 1), min(6 * r, x.shape[-1])
    # Weights that give the value at the end of the line through `near` samples.
    weights = np.linalg.pinv(np.c_[np.ones(near), np.arange(near)])[0]
    first = (x[..., :near] @ weights)[..., None]
    last = (x[..., : -near - 1 : -1] @ weights)[..., None]
    before, after = 2 * first - x[..., reach:0:-1], 2 * last - x[..., -2 : -reach - 2 : -1]
    return np.concatenate([before, x, after], axis=-1), reach


def decimation_reach(factor: int) -> int:
    """Samples to each side beyond which an input no longer shows in a decimated output (below 1e-12 of it)."""
    from scipy import signal

    reach, stride = 0, 1
    for r in decimation_passes(factor):
        pole = np.abs(signal.cheby1(CHEBYSHEV_ORDER, CHEBYSHEV_RIPPLE_DB, 0.8 / r, output="zpk")[1]).max()
        reach += stride * int(np.ceil(np.log(1e-14) / np.log(pole)))
        stride *= r
    return reach


def lowpass_reach(cutoff_hz: float, sample_rate_hz: float) -> int:
    """Samples to each side beyond which an input no longer shows in the filtered signal (below 1e-12 of it)."""
    from scipy import signal

    pole = np.abs(signal.butter(BUTTERWORTH_ORDER, cutoff_hz, fs=sample_rate_hz, output="zpk")[1]).max()
    return int(np.ceil(np.log(1e-14) / np.log(pole)))


def motion_between(
    q: Array, tau: Array, *, cutoff_hz: float | None, sample_rate_hz: float, start: int, stop: int
) -> Motion:
    """Filtered motion of the samples `start` to `stop` of q, tau (N, n).

    `cutoff_hz` None leaves q as it is. Only as much of q beyond the range is filtered as can show in it, so long
    recordings pass through in blocks and give what one pass over the whole gives.
    """
    if not cutoff_hz:
        return motion_of_filtered(q, tau, sample_rate_hz=sample_rate_hz, start=start, stop=stop)
    margin = _DIFFERENCES + lowpass_reach(cutoff_hz, sample_rate_hz)
    low, high = max(0, start - margin), min(len(q), stop + margin)
    part = lowpass(q[low:high], cutoff_hz, sample_rate_hz)
    motion = motion_of_filtered(part, tau[low:high], sample_rate_hz=sample_rate_hz, start=start - low, stop=stop - low)
    return replace(motion, t_s=np.arange(start, stop) / sample_rate_hz)


def motion_of_filtered(q: Array, tau: Array, *, sample_rate_hz: float, start: int, stop: int) -> Motion:
    """Motion of the samples `start` to `stop` of q, tau (N, n), with q as it is, such as filtered."""
    low, high = max(0, start - _DIFFERENCES), min(len(q), stop + _DIFFERENCES)
    dq = differentiate(q[low:high], sample_rate_hz)
    ddq = differentiate(dq, sample_rate_hz)
    inside = slice(start - low, stop - low)
    return Motion(
        t_s=np.arange(start, stop) / sample_rate_hz,
        q=np.array(q[start:stop]),
        dq=dq[inside],
        ddq=ddq[inside],
        tau=np.array(tau[start:stop]),
    )
