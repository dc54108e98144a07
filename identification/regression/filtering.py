"""Zero-phase filters: the low-pass of the position, and the parallel decimation of torque and regressor.

Filters are applied to the spectrum, by the responses that Butterworth's and Chebyshev's poles give. Forward and backward
together they have the real gain |H|². The low-pass has the ends of MATLAB's `filtfilt`; decimation keeps the last sample, as
its `decimate` does. Decimation smooths the ends; MATLAB's own edge rule, on which published digits rest, is there on request.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError

BUTTERWORTH_ORDER = 4
CHEBYSHEV_ORDER = 8
CHEBYSHEV_RIPPLE_DB = 0.05
LARGEST_PASS = 13  # a decimation by more goes in several passes
FOLDED = 1e-3  # of the amplitude in the band that is kept: most that may fold into it
NOTHING = 1e-14  # of an input: less than rounding leaves of it


def lowpass(x: Array, cutoff_hz: float, sample_rate_hz: float) -> Array:
    """Butterworth of order 4, forward and backward, along axis 0 (time); `cutoff_hz` is that of one direction, as in papers."""
    if not 0 < cutoff_hz < sample_rate_hz / 2:
        raise IdentificationError(
            key="cut-off",
            value=cutoff_hz,
            shown=f"{cutoff_hz:g} Hz",
            expected=f"between 0 and {sample_rate_hz / 2:g} Hz, half the rate",
        )
    padding = 3 * BUTTERWORTH_ORDER
    if len(x) <= padding:
        raise IdentificationError(key="samples to filter", value=len(x), expected=f"more than {padding}")
    # Counted from the first sample, a joint that stands still stays at exactly zero: rounding is no motion.
    filtered = _butterworth(cutoff_hz, sample_rate_hz).forward_backward((x - x[0]).T, padding)
    return np.asarray(np.ascontiguousarray(filtered.T) + x[0])


def forward_backward_3db_hz(cutoff_hz: float, sample_rate_hz: float) -> float:
    """Frequency at which the filter, forward and backward, is down by 3 dB (a factor of sqrt(1/2))."""
    x = (np.sqrt(2.0) - 1.0) ** (1 / (2 * BUTTERWORTH_ORDER))
    return float(sample_rate_hz / np.pi * np.arctan(x * np.tan(np.pi * cutoff_hz / sample_rate_hz)))


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

    def filtered_strided(self, x: Array, head: Array, tail: Array) -> Array:
        """What `filtered` gives of a series of which x is every `stride_behind`-th sample, counted from the last one.

        `head` and `tail` are all of its first samples, up to one of x, and of its last: `end_samples` and up to a stride more.
        """
        r, *others = decimation_passes(self.factor)
        k, N = _chebyshev(r).reach // r + 1, x.shape[-1]
        size = _fast_size(N + 2 * k)
        extended = np.concatenate([x, np.repeat(x[..., -1:], size - N, -1)], axis=-1)
        gain = np.abs(_chebyshev(r).response(size * r)[: size // 2 + 1]) ** 2
        passed = np.fft.irfft(np.fft.rfft(extended) * gain, size)[..., k : N - k]
        y = np.concatenate([_decimated(head, r)[..., :k], passed, _decimated(tail, r)[..., -k:]], axis=-1)
        for r in others:
            y = _decimated(y, r)
        return np.ascontiguousarray(y)

    @property
    def end_samples(self) -> int:
        """Samples at each end of which `filtered_strided` takes all: twice as many as the first pass reaches."""
        r = decimation_passes(self.factor)[0]
        return 2 * r * (_chebyshev(r).reach // r + 1)

    def stride_behind(self, cutoff_hz: float | None, sample_rate_hz: float) -> int:
        """Samples that can be skipped of what follows smoothly from a position behind the low-pass: the first pass, or 1.

        Noise of an acceleration rises with the square of frequency, up to the low-pass. What of it folds into the band that is
        kept may have a thousandth of the amplitude that stands there.
        """
        passes = decimation_passes(self.factor)
        if cutoff_hz is None or len(passes) < 2 or not self.smooth_ends:
            return 1
        f = np.linspace(0.0, 0.5 * sample_rate_hz, 2001)
        kept_hz, size = 0.8 * 0.5 * sample_rate_hz / self.factor, 2 * (len(f) - 1)
        amplitude = f**2 * np.abs(_butterworth(cutoff_hz, sample_rate_hz).response(size)) ** 2
        folded = amplitude[f >= sample_rate_hz / passes[0] - kept_hz]
        return passes[0] if folded.max(initial=0.0) <= FOLDED * amplitude[f <= kept_hz].max() else 1

    def kept(self, x: Array) -> Array:
        """The samples of x (N, n) at the instants that are kept, unfiltered."""
        return x[self.instants(len(x))]

    def instants(self, N: int) -> NDArray[np.intp]:
        """Which of N samples are kept: the last one, and every `factor`-th before it."""
        return np.arange((N - 1) % self.factor, N, self.factor)


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
    for r in decimation_passes(factor):
        padding = 3 * CHEBYSHEV_ORDER
        if x.shape[-1] <= padding:
            samples = x.shape[-1]
            raise IdentificationError(key=f"samples to decimate by {r}", value=samples, expected=f"more than {padding}")
        first = (x.shape[-1] - 1) % r
        x = _decimated(x, r) if smooth_ends else _chebyshev(r).forward_backward(x, padding)[..., first::r]
    return np.ascontiguousarray(x)


def _decimated(x: Array, r: int) -> Array:
    """One pass by r with smooth ends. Of a spectrum, every r-th sample is the sum of its r parts of equal length."""
    N, reach, near = x.shape[-1], _chebyshev(r).reach, min(6 * r, x.shape[-1])
    first_kept = (N - 1) % r
    lead = reach + (-(reach + first_kept)) % r  # a multiple of r before the first sample that is kept
    rows = _fast_size(-(-(lead + N + reach) // r))
    extended = np.empty((*x.shape[:-1], rows * r))
    extended[..., lead : lead + N] = x
    # Odd reflection at the end of a line through the last samples: the weights give its value there.
    line = np.linalg.pinv(np.c_[np.ones(near), np.arange(near)])[0]
    first, last = x[..., :near] @ line, x[..., : -near - 1 : -1] @ line
    begin, end = lead - min(reach, N - 1), lead + N + min(reach, N - 1)
    extended[..., begin:lead] = 2 * first[..., None] - x[..., lead - begin : 0 : -1]
    extended[..., lead + N : end] = 2 * last[..., None] - x[..., -2 : N - 2 - end + lead : -1]
    extended[..., :begin], extended[..., end:] = extended[..., begin, None], extended[..., end - 1, None]
    gain = _gain(r, rows)
    spectrum = np.fft.rfft(extended)[..., : len(gain)] * gain
    folded = np.zeros((*x.shape[:-1], rows // 2 + 1), dtype=complex)
    for start in range(0, len(gain), rows):
        above, below = spectrum[..., start:][..., : rows // 2 + 1], spectrum[..., max(0, start - rows // 2) : start]
        folded[..., : above.shape[-1]] += above
        folded[..., 1 : below.shape[-1] + 1] += below[..., ::-1].conj()
        folded[..., 0] += above[..., 0].conj() * (start > 0)
    kept = (lead + first_kept) // r
    return np.asarray(np.fft.irfft(folded, rows)[..., kept : kept + -(-N // r)] / r)


@lru_cache
def _gain(r: int, rows: int) -> Array:
    """|H|² before decimation by r at the frequencies of `rows` r samples, as far as it is more than nothing."""
    gain = np.abs(_chebyshev(r).response(rows * r)) ** 2
    last = int(np.flatnonzero(gain > 1e-3 * NOTHING)[-1])
    above = -(-last // rows) * rows  # the part that ends here is folded back whole
    return np.asarray(gain[: above + 1 if above - rows // 2 <= last else last + 1])


def decimation_reach(factor: int) -> int:
    """Samples to each side beyond which an input no longer shows in a decimated output."""
    reach, stride = 0, 1
    for r in decimation_passes(factor):
        reach += stride * _chebyshev(r).reach
        stride *= r
    return reach


def lowpass_reach(cutoff_hz: float, sample_rate_hz: float) -> int:
    """Samples to each side beyond which an input no longer shows in the filtered signal."""
    return _butterworth(cutoff_hz, sample_rate_hz).reach


@dataclass(frozen=True, eq=False)
class _Filter:
    """A low-pass in discrete time: an analogue one with cut-off 1 and these poles (n,), its frequencies warped."""

    poles: NDArray[np.complexfloating]
    cutoff: float  # share of half the rate
    dc: float = 1.0  # gain at frequency 0

    @property
    def warp(self) -> float:
        return float(np.tan(0.5 * np.pi * self.cutoff))

    @property
    def reach(self) -> int:
        """Samples in which the slowest pole dies away."""
        p = self.poles * self.warp
        return int(np.ceil(np.log(NOTHING) / np.log(np.abs((1 + p) / (1 - p)).max())))

    def response(self, size: int) -> NDArray[np.complexfloating]:
        """H at the frequencies of the spectrum of `size` samples."""
        s = 1j * np.minimum(np.tan(np.pi * np.arange(size // 2 + 1) / size) / self.warp, 1e9)
        return np.asarray(self.dc * np.prod([p / (p - s) for p in self.poles], axis=0))

    def forward_backward(self, x: Array, padding: int) -> Array:
        """x (..., N) filtered forward and backward as by MATLAB's `filtfilt`.

        The ends are reflected at the end samples for `padding` samples. Each direction starts in the steady state of the
        first sample that it sees, as if that had always been there.
        """
        N, lead = x.shape[-1], self.reach + padding
        size = _fast_size(lead + N + lead)
        H, end = self.response(size), lead + N + padding
        extended = np.empty((*x.shape[:-1], size))
        extended[..., lead - padding : lead] = 2 * x[..., :1] - x[..., padding:0:-1]
        extended[..., lead : lead + N] = x
        extended[..., lead + N : end] = 2 * x[..., -1:] - x[..., -2 : -padding - 2 : -1]
        extended[..., : self.reach] = extended[..., self.reach, None]
        extended[..., end:] = extended[..., self.reach, None]  # a spectrum's signal is periodic
        forward = np.fft.irfft(np.fft.rfft(extended) * H, size)
        forward[..., end:] = forward[..., end - 1, None]
        return np.asarray(np.fft.irfft(np.fft.rfft(forward) * H.conj(), size)[..., lead : lead + N])


def _butterworth(cutoff_hz: float, sample_rate_hz: float) -> _Filter:
    n = BUTTERWORTH_ORDER
    poles = np.exp(1j * np.pi * (2 * np.arange(1, n + 1) + n - 1) / (2 * n))
    return _Filter(poles, 2 * cutoff_hz / sample_rate_hz)


@lru_cache
def _chebyshev(r: int) -> _Filter:
    """The filter before every r-th sample is kept; of even order, it is at the foot of its ripple at frequency 0."""
    n, floor = CHEBYSHEV_ORDER, 10 ** (-CHEBYSHEV_RIPPLE_DB / 20)
    a = np.arctanh(floor) / n  # sinh(n a) = 1/eps, eps² = 1/floor² - 1
    angles = np.pi * (2 * np.arange(1, n + 1) - 1) / (2 * n)
    return _Filter(-np.sinh(a) * np.sin(angles) + 1j * np.cosh(a) * np.cos(angles), 0.8 / r, floor)


def _fast_size(least: int) -> int:
    """The smallest number from `least` on whose factors are 2, 3 and 5: its transform is quick."""
    size = least
    while True:
        left = size
        for factor in (2, 3, 5):
            while left % factor == 0:
                left //= factor
        if left == 1:
            return size
        size += 1
