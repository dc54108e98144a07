"""SYNC: sending or waiting, lateness, jitter, and real-time scheduling.

The system must permit real-time scheduling and locked memory. The recording shows what it granted.
"""

import ctypes
import gc
import os
import resource
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np

from ..bus import Master
from ..errors import BusFaultError, RefusedError
from ..robot import BusFile

# In motion SYNC may be late by the larger of the two, unless `[bus] late_sync_s` is given.
MAX_LATE_PERIODS, MAX_LATE_S = 3, 0.02
# At rest, the SYNC of another producer may be absent for so many periods.
MAX_ABSENT_PERIODS = 50
# Drives must answer SYNC within this share of a period.
MAX_ANSWER_SHARE = 0.7


def largest_delay_s(file: BusFile) -> float:
    """Return how late SYNC may be in motion, s."""
    return (
        max(MAX_LATE_PERIODS * file.sync_period_s, MAX_LATE_S)
        if file.late_sync_s is None
        else file.late_sync_s
    )


class Pace:
    """The pace of SYNC: each SYNC is sent or awaited, then its answers are received.

    Attributes:
        next_ns: time at which the next SYNC is due, ns.
    """

    def __init__(self, master: Master) -> None:
        file = master.bus.file
        self._master, self._link, self._period_ns = master, master.link, master.bus.period_ns
        self._ours = file.sync_producer == "recorder"
        self._latest_ns, self.next_ns = round(largest_delay_s(file) * 1e9), 0

    def start(self) -> None:
        """Schedule the first SYNC one period from now."""
        self.next_ns = self._link.now_ns() + self._period_ns

    def sync(self, *, in_motion: bool) -> None:
        """Wait until SYNC is due, send it, and take the answers.

        If another producer sends SYNC, the method waits for that SYNC instead.

        Raises
        ------
        BusFaultError : SYNC is absent, or later than motion allows. Drives would stop at their last
            target, and the next target would be a step.
        """
        if self._ours:
            self._master.wait(self.next_ns)
            self._refuse_late(in_motion)
            if self._link.now_ns() > self.next_ns + self._period_ns:
                # After a delay the period starts anew, so that no burst of SYNCs is sent.
                self.next_ns = self._link.now_ns()
            self._master.sync()
        else:
            patience_ns = self._latest_ns if in_motion else MAX_ABSENT_PERIODS * self._period_ns
            if not self._master.wait_for_sync(self.next_ns + patience_ns):
                raise BusFaultError(
                    f"no SYNC was received in {patience_ns / self._period_ns:.3g} periods",
                    place="bus",
                    advice="Start the other SYNC producer, or set sync_producer = 'recorder'",
                )
            self._refuse_late(in_motion)
            self.next_ns = self._link.now_ns()
        self._master.wait(
            self.next_ns + round(MAX_ANSWER_SHARE * self._period_ns), for_answers=True
        )
        self.next_ns += self._period_ns

    def _refuse_late(self, in_motion: bool) -> None:
        late_ns = self._link.now_ns() - self.next_ns
        if in_motion and late_ns > self._latest_ns:
            raise BusFaultError(
                f"SYNC was {late_ns * 1e-9:.3g} s late in motion, more than "
                f"{self._latest_ns * 1e-9:.3g} s: this computer was busy or stopped"
            )


# SCHED_FIFO has priorities from 1 to 99. This one is below those of the kernel's threads.
PRIORITY = 20
MCL_CURRENT, MCL_FUTURE = 1, 2  # of mlockall(2)
MAX_JITTER_SYNCS, MIN_JITTER_SYNCS, MAX_JITTER_S = 200, 20, 1.0
# So many standard deviations of the jitter must be within the largest delay of SYNC.
DEVIATIONS = 3


def scheduling_words(granted: Mapping[str, float]) -> str:
    """Describe what `real_time_scheduling` was granted."""
    fifo = (
        f"SCHED_FIFO, priority {PRIORITY}"
        if granted["sched_fifo"]
        else "SCHED_OTHER: SCHED_FIFO is not permitted (rtprio)"
    )
    locked = "locked" if granted["memory_locked"] else "not locked: memlock is not unlimited"
    return f"{fifo}; memory {locked}"


@contextmanager
def real_time_scheduling() -> Iterator[dict[str, float]]:
    """Use real-time scheduling and locked memory inside the block, if permitted.

    Garbage is not collected inside the block. It yields what was granted, as counters of `/health`.
    """
    policy, parameter, collected = os.sched_getscheduler(0), os.sched_getparam(0), gc.isenabled()
    gc.collect()
    gc.disable()
    # With a limit of locked memory, allocations beyond it would fail in the middle of a session.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    libc = ctypes.CDLL(None, use_errno=True)
    fifo = False
    # The system may not permit it. Because of RESET_ON_FORK, child processes do not inherit it.
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
        fifo = True
    locked = unlimited and libc.mlockall(MCL_CURRENT | MCL_FUTURE) == 0
    try:
        yield {"sched_fifo": float(fifo), "memory_locked": float(locked)}
    finally:
        if locked:
            libc.munlockall()
        if fifo:
            with suppress(OSError):
                os.sched_setscheduler(0, policy, parameter)
        if collected:
            gc.enable()
            gc.collect()


@dataclass(frozen=True, kw_only=True)
class Jitter:
    """Statistics of the intervals between SYNCs.

    Attributes:
        sd_s: standard deviation, s.
        worst_s: largest difference from the period, s.
        off: share of intervals that differ by more than half a period, 0 to 1.
        largest_s: largest delay of SYNC that is accepted in motion, s.
    """

    sd_s: float
    worst_s: float
    off: float
    largest_s: float

    @property
    def fit_for_motion(self) -> bool:
        """True if three standard deviations are within the largest delay."""
        return DEVIATIONS * self.sd_s <= self.largest_s


def sync_jitter(master: Master) -> Jitter:
    """Measure the jitter of SYNC over 200 periods or a second, but at least 20 periods.

    Nothing is sent. If this master produces SYNC, the times at which it would be sent are measured,
    otherwise the times at which SYNC arrives.

    Raises
    ------
    BusFaultError : SYNC of the other producer is absent for 50 periods.
    """
    file, period_ns, link = master.bus.file, master.bus.period_ns, master.link
    count = min(MAX_JITTER_SYNCS, max(MIN_JITTER_SYNCS, round(MAX_JITTER_S * 1e9 / period_ns)))
    if file.sync_producer == "recorder":
        times, begin_ns = [], link.now_ns()
        for k in range(count):
            master.wait(begin_ns + (k + 1) * period_ns)
            times.append(link.now_ns())
    else:
        first = len(master.sync_times)
        for _ in range(count):
            if not master.wait_for_sync(link.now_ns() + MAX_ABSENT_PERIODS * period_ns):
                raise BusFaultError(
                    f"no SYNC was received in {MAX_ABSENT_PERIODS} periods",
                    place="bus",
                    advice="Start the other SYNC producer",
                )
        times = master.sync_times[first:]
    deviation_s = np.abs(np.diff(times) - period_ns) * 1e-9
    return Jitter(
        sd_s=float(np.diff(times).std() * 1e-9),
        worst_s=float(deviation_s.max()),
        off=float(np.mean(deviation_s > period_ns * 0.5e-9)),
        largest_s=largest_delay_s(file),
    )


def refuse_jitter(master: Master) -> Jitter:
    """Check that the jitter of SYNC is small enough for motion, and return it.

    Raises
    ------
    RefusedError : the jitter is too large.
    BusFaultError : SYNC of the other producer is absent for 50 periods.
    """
    found = sync_jitter(master)
    if not found.fit_for_motion:
        raise RefusedError(
            f"{DEVIATIONS} standard deviations exceed {found.largest_s * 1e3:g} ms, the largest "
            "delay in motion",
            what="motion",
            place="bus",
            key="SYNC jitter sd",
            value=found.sd_s,
            shown=f"{found.sd_s * 1e3:.3f} ms",
            advice="End other programs, or permit SCHED_FIFO (acquisition/docs/recording.md)",
        )
    return found
