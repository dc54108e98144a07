"""The motion of a recording behind a low-pass, filtered once for all who need it."""

from ..arrays import Array
from ..data import Signals
from .filtering import Motion, lowpass, motion_between, motion_of_filtered

_NUMBERS_KEPT = 4_000_000  # of a filtered position, 32 MB; a longer recording is filtered anew by each pass over it


class FilteredMotion:
    """Motion of a recording's samples at any cut-off; each cut-off is filtered once, unless the recording is long."""

    def __init__(self, signals: Signals) -> None:
        self._signals = signals
        self._filtered: dict[float, Array] = {}

    def between(self, start: int, stop: int, cutoff_hz: float | None) -> Motion:
        """Motion of the samples `start` to `stop`; `cutoff_hz` None leaves the position as it is."""
        s = self._signals
        if cutoff_hz is None or s.q.size > _NUMBERS_KEPT:
            return motion_between(
                s.q, s.effort, cutoff_hz=cutoff_hz, sample_rate_hz=s.sample_rate_hz, start=start, stop=stop
            )
        if cutoff_hz not in self._filtered:
            self._filtered[cutoff_hz] = lowpass(s.q, cutoff_hz, s.sample_rate_hz)
        return motion_of_filtered(
            self._filtered[cutoff_hz], s.effort, sample_rate_hz=s.sample_rate_hz, start=start, stop=stop
        )
