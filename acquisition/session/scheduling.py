"""SYNC in step on a busy machine: SCHED_FIFO, memory locked, no garbage collection in motion; and how evenly it comes.

Each only where the system permits it; what was granted is reported.
"""

import ctypes
import gc
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np

from ..errors import AcquisitionError
from ..master import Master
from .pacing import largest_delay_s

PRIORITY = 20  # of SCHED_FIFO, 1 to 99: above all ordinary processes, below the kernel's own threads
MCL_CURRENT, MCL_FUTURE = 1, 2  # of mlockall(2)
JITTER_SYNCS, FEWEST_SYNCS, JITTER_S = 200, 20, 1.0
DEVIATIONS = 3  # of the jitter that must stay within the largest delay of SYNC


@dataclass(frozen=True, kw_only=True)
class Scheduling:
    """What this process was granted."""

    fifo: bool
    locked: bool

    @property
    def words(self) -> str:
        """For people."""
        fifo = f"SCHED_FIFO, priority {PRIORITY}" if self.fifo else "SCHED_OTHER: SCHED_FIFO is not permitted (rtprio)"
        return f"{fifo}; memory {'locked' if self.locked else 'not locked: memlock is not unlimited'}"

    @property
    def counters(self) -> dict[str, float]:
        """For `/health`."""
        return {"sched_fifo": float(self.fifo), "memory_locked": float(self.locked)}


@contextmanager
def steady() -> Iterator[Scheduling]:
    """Real-time scheduling for this thread while SYNC is produced. Child processes that exist keep theirs, new ones get none.

    SCHED_FIFO with SCHED_RESET_ON_FORK where permitted, mlockall where the limit of locked memory is unlimited, and no
    garbage collection inside.
    """
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    collected = gc.isenabled()
    gc.collect()
    gc.disable()
    granted = Scheduling(fifo=_fifo(), locked=_lock_memory())
    try:
        yield granted
    finally:
        if granted.locked:
            _libc().munlockall()
        if granted.fifo:
            with suppress(OSError):
                os.sched_setscheduler(0, policy, parameter)
        if collected:
            gc.enable()
            gc.collect()


def _fifo() -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except OSError:
        return False
    return True


def _lock_memory() -> bool:
    """With a limit, allocations beyond it would fail in the middle of a session."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    return soft == resource.RLIM_INFINITY and _libc().mlockall(MCL_CURRENT | MCL_FUTURE) == 0


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True, kw_only=True)
class Jitter:
    """Intervals of SYNC: their standard deviation and largest error, s, and the share more than half a period off."""

    sd_s: float
    worst_s: float
    off: float
    largest_s: float  # delay of SYNC that a session in motion bears

    @property
    def fit_for_motion(self) -> bool:
        """Whether three standard deviations stay within the largest delay."""
        return DEVIATIONS * self.sd_s <= self.largest_s


def sync_jitter(master: Master) -> Jitter:
    """Measure for up to a second how evenly SYNC is sent from here, or arrives from its producer. Nothing is sent.

    Raises `AcquisitionError` where another producer's SYNC does not come.
    """
    file, period_ns, link = master.bus.file, master.bus.period_ns, master.link
    count = min(JITTER_SYNCS, max(FEWEST_SYNCS, round(JITTER_S * 1e9 / period_ns)))
    if file.sync_producer == "recorder":
        times = []
        next_ns = link.now_ns() + period_ns
        for _ in range(count):
            master.wait(next_ns)
            times.append(link.now_ns())
            next_ns += period_ns
    else:
        first = len(master.sync_times)
        for _ in range(count):
            if not master.wait_for_sync(link.now_ns() + 50 * period_ns):
                raise AcquisitionError("bus: no SYNC in 50 periods: expected the other producer's")
        times = master.sync_times[first:]
    deviation_s = np.abs(np.diff(times) - period_ns) * 1e-9
    return Jitter(
        sd_s=float(np.diff(times).std() * 1e-9),
        worst_s=float(deviation_s.max()),
        off=float(np.mean(deviation_s > period_ns * 0.5e-9)),
        largest_s=largest_delay_s(file),
    )


def refuse_jitter(master: Master) -> Jitter:
    """Measure, and raise `AcquisitionError` where SYNC would be too late too often to move anything."""
    found = sync_jitter(master)
    if not found.fit_for_motion:
        raise AcquisitionError(
            f"bus: SYNC jitter sd {found.sd_s * 1e3:.3f} ms: {DEVIATIONS} of it are more than {found.largest_s * 1e3:g} ms, "
            "the largest delay in motion: expected less; stop other programs, or permit SCHED_FIFO (acquisition/README.md)"
        )
    return found
