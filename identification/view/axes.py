"""Axes of charts: numbers between two ends as positions in pixels, and the ticks between them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A scale through the monotonic function `by`, with texts at its `ticks`."""

    low: float
    high: float
    ticks: Mapping[float, str]
    by: Callable[[Array], Array] = np.asarray

    def place(self, x: ArrayLike, left: float, right: float) -> Array:
        """Positions between two edges; what is beyond the ends is drawn there."""
        low, high = self.by(np.array([self.low, self.high]))
        share = np.clip(
            (self.by(np.asarray(x, dtype=float)) - low) / ((high - low) or 1.0), 0.0, 1.0
        )
        return np.asarray(left + (right - left) * share)


def linear(low: float, high: float, most: int) -> Axis:
    """Between two ends, with at most `most` ticks at multiples of 1, 2 or
    5 times a power of ten.
    """
    if not high > low:
        return Axis(low=low, high=high, ticks={low: f"{low:.3g}"})
    least = (high - low) / most
    power = 10.0 ** math.floor(math.log10(least))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least * (1 - 1e-9))
    values = [step * k + 0.0 for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
    form = f".{max(0, -math.floor(math.log10(step) + 1e-9))}f" if 1e-7 < step < 1e5 else ".3g"
    return Axis(low=low, high=high, ticks={value: f"{value:{form}}" for value in values})


def logarithmic(low: float, high: float, most: int) -> Axis:
    """Between two ends above zero, with ticks at powers of ten."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    ticks = {
        10.0**power: f"{10.0**power:g}" if -3 <= power <= 4 else f"1e{power}"
        for power in range(first, last + 1, max(1, math.ceil((last - first) / most)))
    }
    return Axis(low=low, high=high, ticks=ticks, by=lambda x: np.log10(np.maximum(x, low)))


def decades(values: ArrayLike, most: int) -> Axis:
    """A logarithmic axis of whole powers of ten around values above zero."""
    low, high = float(np.min(values)), float(np.max(values))
    return logarithmic(
        10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high)), most
    )
