"""Detects that the machine's clock was set: frames have its time, and a step must not be read as a pause of SYNC."""

import time
from collections.abc import Callable

SMALLEST_STEP_NS = 50_000_000  # a clock that NTP only slews drifts less than this in half a second
_SLOWEST_READ_NS = 5_000_000  # of the two clocks, one after the other; slower readings are not used


class WallClock:
    """Compares the clock that can be set with the one that cannot."""

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._offset_ns: int | None = None
        self.step_ns()

    def step_ns(self) -> int:
        """By how much the clock was set since the last call, forward or back; 0 where it was not."""
        before = self._monotonic_ns()
        offset = self._wall_ns() - before
        if self._monotonic_ns() - before > _SLOWEST_READ_NS:
            return 0
        step = 0 if self._offset_ns is None else offset - self._offset_ns
        self._offset_ns = offset
        return step if abs(step) >= SMALLEST_STEP_NS else 0


def describe_step(step_ns: int) -> str:
    """For the events of a recording."""
    return f"the clock was set {'forward' if step_ns > 0 else 'back'} by {abs(step_ns) * 1e-9:.3g} s"
