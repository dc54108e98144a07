"""Detects that the machine's clock was set: frames have its time, and a step must not be read as a pause of SYNC."""

import time
from collections.abc import Callable

import numpy as np

from ..arrays import Ints

SMALLEST_STEP_NS = 50_000_000  # a clock that NTP only slews drifts less than this in half a second
_SLOWEST_READ_NS = 5_000_000  # of the two clocks, one after the other; slower readings are repeated
_READINGS = 5
_BLOCKS_WAITED = 2  # for the stamps to jump


class WallClock:
    """Compares the clock that can be set with the one that cannot, and continues its times as if it had not been set.

    `offset_ns` is the difference of the two at the beginning of a session; without it the present one.
    """

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        offset_ns: int | None = None,
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._begin_ns = wall_ns() - monotonic_ns() if offset_ns is None else offset_ns
        self._offset_ns = self._begin_ns
        self._last_ns: int | None = None  # latest stamp, as it was given
        self._pending_ns, self._waited = 0, 0  # a step that no stamp has had yet, and for how many blocks
        self.shift_ns = 0  # sum of the steps that stamps have had

    def now_ns(self) -> int:
        """Time as if the clock had never been set."""
        return self._begin_ns + self._monotonic_ns()

    def step_ns(self) -> int:
        """By how much the clock was set since the last call, forward or back; 0 where it was not."""
        for _ in range(_READINGS):
            before = self._monotonic_ns()
            offset = self._wall_ns() - before
            if self._monotonic_ns() - before <= _SLOWEST_READ_NS:
                break
        else:
            return 0
        step, self._offset_ns = offset - self._offset_ns, offset
        if abs(step) < SMALLEST_STEP_NS:
            return 0
        self._pending_ns, self._waited = self._pending_ns + step, 0
        return step

    def continued(self, stamps: Ints) -> Ints:
        """Stamps of frames, block by block, without the steps that `step_ns` found: each begins where stamps jump by it."""
        if not len(stamps):
            return stamps
        shifts: Ints = np.full(len(stamps), self.shift_ns)
        if self._pending_ns:
            before = self._last_ns if self._last_ns is not None else stamps[0] - self._pending_ns
            jumps = np.diff(stamps, prepend=before) * (1 if self._pending_ns > 0 else -1)
            k = int(np.argmax(jumps))
            if jumps[k] > abs(self._pending_ns) / 2:
                shifts[k:] += self._pending_ns
                self.shift_ns, self._pending_ns = self.shift_ns + self._pending_ns, 0
            self._waited += 1
            if self._waited > _BLOCKS_WAITED:  # an adapter with a clock of its own
                self._pending_ns = 0
        self._last_ns = int(stamps[-1])
        continued: Ints = stamps - shifts
        return continued


def describe_step(step_ns: int) -> str:
    """For the events of a recording."""
    return f"the clock was set {'forward' if step_ns > 0 else 'back'} by {abs(step_ns) * 1e-9:.3g} s"
