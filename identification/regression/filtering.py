"""Zero-phase filters: low-pass of the position, parallel decimation of torque and regressor.

Filters multiply the spectrum by the response of Butterworth or Chebyshev poles; forward and
backward the gain is |H|², which is real. The low-pass treats the ends as MATLAB's `filtfilt`;
decimation keeps the last sample, as MATLAB's `decimate`. Decimation smooths the ends; MATLAB's own
rule for the ends, used for published digits, is an option.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from itertools import count

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import BadInputError, NoFitError

from ..arrays import Array, Bools, Ints

BUTTERWORTH_ORDER = 4
CHEBYSHEV_ORDER = 8
CHEBYSHEV_RIPPLE_DB = 0.05
MAX_PASS = 13  # decimation by a larger factor takes several passes
MAX_ALIAS = 1e-3  # of the amplitude in the passband, that may fold into it
MIN_RESPONSE = 1e-14  # of an input, below rounding
# Numbers that are filtered at a time; more would leave the cache, and take twice as long.
_IN_CACHE = 120_000


def lowpass(x: Array, cutoff_hz: float, sample_rate_hz: float) -> Array:
    """Filter x along axis 0 (time) by equation (A): Butterworth of order 4, both directions.

        q^ = |H(w)|² q                                                                   (A)

    Parameters
    ----------
    x : (N, n) samples.
    cutoff_hz : -3 dB frequency of one direction, Hz.
    sample_rate_hz : sample rate, Hz.

    Raises
    ------
    BadInputError : the cut-off is not between 0 and half the sample rate.
    NoFitError : there are too few samples.
    """
    if not 0 < cutoff_hz < sample_rate_hz / 2:
        raise BadInputError(
            key="cut-off",
            value=cutoff_hz,
            shown=f"{cutoff_hz:g} Hz",
            expected=f"more than 0 and less than {sample_rate_hz / 2:g} Hz, half the sample rate",
        )
    padding = 3 * BUTTERWORTH_ORDER
    if len(x) <= padding:
        raise NoFitError(key="samples to filter", value=len(x), expected=f"more than {padding}")
    # Relative to its first sample a joint at rest stays exactly at zero: rounding does not move it.
    filtered = _butterworth(cutoff_hz, sample_rate_hz).forward_backward((x - x[0]).T, padding)
    return np.asarray(np.ascontiguousarray(filtered.T) + x[0])


def forward_backward_3db_hz(cutoff_hz: float, sample_rate_hz: float) -> float:
    """Return the frequency at which the filter in both directions is down by 3 dB, Hz."""
    x = (np.sqrt(2.0) - 1.0) ** (1 / (2 * BUTTERWORTH_ORDER))
    return float(sample_rate_hz / np.pi * np.arctan(x * np.tan(np.pi * cutoff_hz / sample_rate_hz)))


@dataclass(frozen=True, kw_only=True)
class Decimation:
    """Parallel decimation F of equation (6): Chebyshev low-pass, then every `factor`-th sample.

    The low-pass is zero-phase, of order 8 with 0.05 dB ripple, and cuts off at 0.8/factor of half
    the rate. The last sample is kept, as by MATLAB's `decimate`. Torque and every column of the
    regressor pass the same filter.

    Attributes:
        factor: samples per row, n_d.
        smooth_ends: True to reflect the ends at a line through the last samples. False to reflect
            them at the end samples themselves, as MATLAB does: the rows next to them then have the
            noise of these two samples unfiltered.
    """

    factor: int = 1
    smooth_ends: bool = True

    @property
    def gain(self) -> float:
        """|H|² at frequency 0, which is slightly below 1, as the filters are of even order."""
        return math.prod(_chebyshev(r).dc ** 2 for r in decimation_passes(self.factor))

    def rows(self, samples: int) -> int:
        """Return the number of rows of so many samples."""
        return -(-samples // self.factor)

    def samples(self, rows: slice, N: int) -> slice:
        """Return the samples of a series of N that give these rows, counted from the last one."""
        start, stop = (N - (self.rows(N) - k) * self.factor for k in (rows.start, rows.stop))
        return slice(max(0, start), stop)

    def filtered(self, x: Array) -> Array:
        """Decimate x (..., N) along its last axis."""
        return _some_at_a_time(self._filtered, np.atleast_2d(x)).reshape(*x.shape[:-1], -1)

    def _filtered(self, x: Array) -> Array:
        for r in decimation_passes(self.factor):
            padding = 3 * CHEBYSHEV_ORDER
            if x.shape[-1] <= padding:
                raise NoFitError(
                    key=f"samples to decimate by {r}",
                    value=x.shape[-1],
                    expected=f"more than {padding}",
                )
            x = (
                _decimated(x, r)
                if self.smooth_ends
                else _chebyshev(r).forward_backward(x, padding)[..., (x.shape[-1] - 1) % r :: r]
            )
        return np.ascontiguousarray(x)

    def filtered_strided(self, x: Array, head: Array, tail: Array) -> Array:
        """Decimate a series of which x has every `stride_behind`-th sample, as `filtered`.

        Samples are counted from the last one. `head` and `tail` have all of its first and last
        samples: `end_samples`, and up to a stride more to reach a sample of x.
        """
        return _some_at_a_time(self._filtered_strided, x, head, tail)

    def _filtered_strided(self, x: Array, head: Array, tail: Array) -> Array:
        r, *others = decimation_passes(self.factor)
        k, N = _chebyshev(r).reach // r + 1, x.shape[-1]
        size = fast_size(N + 2 * k)
        extended = np.concatenate([x, np.repeat(x[..., -1:], size - N, -1)], axis=-1)
        passed = np.fft.irfft(np.fft.rfft(extended) * _gain(r, size)[: size // 2 + 1], size)[
            ..., k : N - k
        ]
        y = np.concatenate(
            [_decimated(head, r)[..., :k], passed, _decimated(tail, r)[..., -k:]], axis=-1
        )
        return np.ascontiguousarray(reduce(_decimated, others, y))

    @property
    def end_samples(self) -> int:
        """Number of samples at each end that `filtered_strided` needs."""
        r = decimation_passes(self.factor)[0]
        return 2 * r * (_chebyshev(r).reach // r + 1)

    def stride_behind(self, cutoff_hz: float | None, sample_rate_hz: float) -> int:
        """Return the stride at which a smooth function of the low-passed position is computed.

        It is the first factor of the decimation, or 1. The noise of an acceleration rises with the
        square of frequency, up to the low-pass. A stride is allowed if the amplitude that folds
        into the passband is at most a thousandth of that in it.
        """
        passes = decimation_passes(self.factor)
        if cutoff_hz is None or len(passes) < 2 or not self.smooth_ends:
            return 1
        f = np.linspace(0.0, 0.5 * sample_rate_hz, 2001)
        passband_hz, size = 0.8 * 0.5 * sample_rate_hz / self.factor, 2 * (len(f) - 1)
        amplitude = f**2 * np.abs(_butterworth(cutoff_hz, sample_rate_hz).response(size)) ** 2
        folded = amplitude[f >= sample_rate_hz / passes[0] - passband_hz]
        return (
            passes[0]
            if folded.max(initial=0.0) <= MAX_ALIAS * amplitude[f <= passband_hz].max()
            else 1
        )

    def instants(self, N: int) -> Ints:
        """Return the samples (rows,) of the rows: the last of N, every `factor`-th before it."""
        return np.arange((N - 1) % self.factor, N, self.factor)


def decimation_passes(factor: int) -> tuple[int, ...]:
    """Return factors whose product is `factor`, each at most 13 if possible.

    100, for example, becomes 10 times 10.
    """
    divisors = [d for d in range(2, MAX_PASS + 1) if factor % d == 0]
    if factor <= MAX_PASS or not divisors:
        return (factor,) if factor > 1 else ()
    # The plan with the fewest passes, and of these the most even one, so that the filters have
    # similar and moderate cut-offs.
    plans = [(d, *decimation_passes(factor // d)) for d in divisors]
    return min(plans, key=lambda plan: (max(plan) > MAX_PASS, len(plan), max(plan)))


def _some_at_a_time(f: Callable[..., Array], *series: Array) -> Array:
    """Apply f to series (E, ..., N), as many of E at a time as fit into the cache."""
    size = max(1, _IN_CACHE // max(1, *(x[:1].size for x in series)))
    starts = range(0, max(1, len(series[0])), size)
    return np.concatenate([f(*(x[k : k + size] for x in series)) for k in starts])


def _decimated(x: Array, r: int) -> Array:
    """Decimate x (..., N) once by r, with smooth ends.

    Taking every r-th sample sums the r equal parts of the spectrum.
    """
    N, reach, near = x.shape[-1], _chebyshev(r).reach, min(6 * r, x.shape[-1])
    first_row = (N - 1) % r
    lead = reach + (-(reach + first_row)) % r  # a multiple of r before the first decimated sample
    rows = fast_size(-(-(lead + N + reach) // r))
    extended = np.empty((*x.shape[:-1], rows * r))
    extended[..., lead : lead + N] = x
    # Odd reflection at the end of a line through the last samples.
    line = _line(near)
    first, last = x[..., :near] @ line, x[..., : -near - 1 : -1] @ line
    begin, end = lead - min(reach, N - 1), lead + N + min(reach, N - 1)
    extended[..., begin:lead] = 2 * first[..., None] - x[..., lead - begin : 0 : -1]
    extended[..., lead + N : end] = 2 * last[..., None] - x[..., -2 : N - 2 - end + lead : -1]
    extended[..., :begin], extended[..., end:] = (
        extended[..., begin, None],
        extended[..., end - 1, None],
    )
    gain = _gain(r, rows)
    spectrum = np.fft.rfft(extended)[..., : len(gain)] * gain
    folded = np.zeros((*x.shape[:-1], rows // 2 + 1), dtype=complex)
    for start in range(0, len(gain), rows):
        above, below = (
            spectrum[..., start:][..., : rows // 2 + 1],
            spectrum[..., max(0, start - rows // 2) : start],
        )
        folded[..., : above.shape[-1]] += above
        folded[..., 1 : below.shape[-1] + 1] += below[..., ::-1].conj()
        folded[..., 0] += above[..., 0].conj() * (start > 0)
    first = (lead + first_row) // r
    return np.asarray(np.fft.irfft(folded, rows)[..., first : first + -(-N // r)] / r)


@lru_cache
def _line(near: int) -> Array:
    """Return the weights (near,) of samples in the first value of a line through them."""
    return np.asarray(np.linalg.pinv(np.c_[np.ones(near), np.arange(near)])[0])


@lru_cache
def _gain(r: int, rows: int) -> Array:
    """Return |H|² of a decimation by r at the frequencies of the spectrum of `rows` r samples.

    It ends where it is negligible.
    """
    gain = np.abs(_chebyshev(r).response(rows * r)) ** 2
    last = int(np.flatnonzero(gain > 1e-3 * MIN_RESPONSE)[-1])
    above = -(-last // rows) * rows  # the part that ends here is folded back whole
    return np.asarray(gain[: above + 1 if above - rows // 2 <= last else last + 1])


def decimation_reach(factor: int) -> int:
    """Return the number of samples to each side that affect a decimated row."""
    passes = decimation_passes(factor)
    return sum(math.prod(passes[:k]) * _chebyshev(r).reach for k, r in enumerate(passes))


def lowpass_reach(cutoff_hz: float, sample_rate_hz: float) -> int:
    """Return the number of samples to each side that affect the low-passed signal."""
    return _butterworth(cutoff_hz, sample_rate_hz).reach


class _Filter:
    """A discrete low-pass with the poles (n,) of an analogue one of cut-off 1.

    The bilinear transform maps its frequencies.
    """

    def __init__(self, poles: NDArray[np.complexfloating], cutoff: float, dc: float = 1.0) -> None:
        """Store the poles, a cut-off as share of half the sample rate, and the gain at 0 Hz."""
        self.poles, self.dc = poles, dc
        self.warp = float(np.tan(0.5 * np.pi * cutoff))

    @cached_property
    def reach(self) -> int:
        """Number of samples in which the slowest pole decays."""
        p = self.poles * self.warp
        return int(np.ceil(np.log(MIN_RESPONSE) / np.log(np.abs((1 + p) / (1 - p)).max())))

    def response(self, size: int) -> NDArray[np.complexfloating]:
        """Return H at the frequencies of the spectrum of `size` samples."""
        s = 1j * np.minimum(np.tan(np.pi * np.arange(size // 2 + 1) / size) / self.warp, 1e9)
        return np.asarray(self.dc * np.prod([p / (p - s) for p in self.poles], axis=0))

    def forward_backward(self, x: Array, padding: int) -> Array:
        """Filter x (..., N) forward and backward as MATLAB's `filtfilt`.

        The ends are reflected at the end samples for `padding` samples. Each direction starts in
        the steady state of its first sample.
        """
        N, lead = x.shape[-1], self.reach + padding
        size = fast_size(lead + N + lead)
        H, end = self.response(size), lead + N + padding
        extended = np.empty((*x.shape[:-1], size))
        extended[..., lead - padding : lead] = 2 * x[..., :1] - x[..., padding:0:-1]
        extended[..., lead : lead + N] = x
        extended[..., lead + N : end] = 2 * x[..., -1:] - x[..., -2 : -padding - 2 : -1]
        extended[..., : self.reach] = extended[..., self.reach, None]
        # The transform treats the signal as periodic, so the end has to return to its start.
        extended[..., end:] = extended[..., self.reach, None]
        forward = np.fft.irfft(np.fft.rfft(extended) * H, size)
        forward[..., end:] = forward[..., end - 1, None]
        return np.asarray(np.fft.irfft(np.fft.rfft(forward) * H.conj(), size)[..., lead : lead + N])


def _butterworth(cutoff_hz: float, sample_rate_hz: float) -> _Filter:
    n = BUTTERWORTH_ORDER
    poles = np.exp(1j * np.pi * (2 * np.arange(1, n + 1) + n - 1) / (2 * n))
    return _Filter(poles, 2 * cutoff_hz / sample_rate_hz)


@lru_cache
def _chebyshev(r: int) -> _Filter:
    """Return the filter of one decimation by r.

    It is of even order, hence at the minimum of its ripple at frequency 0.
    """
    n, floor = CHEBYSHEV_ORDER, 10 ** (-CHEBYSHEV_RIPPLE_DB / 20)
    a = np.arctanh(floor) / n  # sinh(n a) = 1/eps, eps² = 1/floor² - 1
    angles = np.pi * (2 * np.arange(1, n + 1) - 1) / (2 * n)
    return _Filter(-np.sinh(a) * np.sin(angles) + 1j * np.cosh(a) * np.cos(angles), 0.8 / r, floor)


def fast_size(least: int) -> int:
    """Return the smallest size from `least` on with no prime factors but 2, 3 and 5.

    The Fourier transform of such a size is fast.
    """
    # Such a size divides a power of 30 that is high enough.
    return next(size for size in count(least) if pow(30, size.bit_length(), size) == 0)


def nearby(x: Bools, reach: int) -> Bools:
    """Dilate the mask x (N,) by `reach` samples to each side."""
    before = np.cumsum(np.pad(x, (reach + 1, reach)))
    return np.asarray(before[2 * reach + 1 :] > before[: -2 * reach - 1])
