"""Live sessions on a machine that does much else: SYNC is slow, and a session that it ends all
the same is tried again.
"""

import functools
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from made_up_buses import bus_text

from acquisition.errors import RobotIdimError
from acquisition.recording import read_recording

# A session may be held up for late_sync_s, and says so before its watchdog acts (0.3 s from SYNC to
# SYNC); a drive for two periods: three SYNCs without an answer are a fault. Simulated drives miss
# SYNC after SYNC_LOST_S, later than both; those of a dry run after 0.1 s of its own time.
SYNC_S = 0.08
GUARDS = "heartbeat_s = 1.0\nlate_sync_s = 0.18"
SYNC_LOST_S = 0.5
TRIES = 3
TOO_BUSY = re.compile(
    r"SYNC was \S+ s late in motion, more than \S+ s: this computer was busy or stopped"
)


def slow_bus_text(n: int, **how: object) -> str:
    """robot.toml of `n` drives at SYNC_S, of joints so sluggish that the loops of simulated
    drives are stable at it.
    """
    text = bus_text(n, period_s=SYNC_S, extra=GUARDS, interface="udp_multicast", **how)  # type: ignore[arg-type]
    return text.replace("bandwidth_hz = 5", "bandwidth_hz = 1").replace("s2 = 4000", "s2 = 160")


def too_busy(folder: Path, failure: BaseException) -> str:
    """The line of the guard that ended a session, from what the test saw or from its
    recordings; empty if none did.
    """
    told = [str(failure)]
    for path in folder.glob("*.mcap"):
        with suppress(RobotIdimError):
            told += [event.text for event in read_recording(path).events if event.kind == "fault"]
    return next((found[0] for text in told if (found := TOO_BUSY.search(text))), "")


def tried_again(test: Callable[..., None]) -> Callable[..., None]:
    """A test of a session in `folder`: where the guard of a late SYNC ended it, again in a
    fresh copy; then skipped.
    """

    @functools.wraps(test)
    def tried(*, folder: Path, **others: object) -> None:
        line = ""
        for number in range(TRIES):
            fresh = shutil.copytree(folder, folder.with_name(f"{folder.name}_{number}"))
            try:
                test(folder=fresh, **others)
            except Exception as failure:
                line = too_busy(fresh, failure)
                if not line:
                    raise
            else:
                return
        pytest.skip(f"{TRIES} times: {line}")

    return tried


@contextmanager
def stalls() -> Iterator[list[float]]:
    """How late this machine wakes a process that sleeps 5 ms, at worst: [seconds]."""
    worst, over = [0.0], threading.Event()

    def sleep() -> None:
        while not over.is_set():
            began = time.monotonic()
            time.sleep(0.005)
            worst[0] = max(worst[0], time.monotonic() - began - 0.005)

    thread = threading.Thread(target=sleep)
    thread.start()
    try:
        yield worst
    finally:
        over.set()
        thread.join()
