"""The second stop: the recorder's process stops the drives of a session that dies or hangs in motion.

The session sends a sign of life through a pipe at every SYNC, from its SYNC loop alone. The first one arms; only a session
that has ended in order disarms. When the pipe ends or stays silent, the bus is opened for sending and `stop_drives` runs.
"""

import os
import select
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from multiprocessing.connection import Connection

from ..bus import not_disabled, stop_drives
from ..errors import AcquisitionError
from ..robot import Bus, BusFile

SILENT_S = 0.3
SILENT_PERIODS = 3  # of SYNC, where they are longer
ALIVE, ENDED = b"\1", b"\0"


def silence_s(file: BusFile) -> float:
    """Time without a sign of life after which the session counts as hung."""
    return max(SILENT_S, SILENT_PERIODS * file.sync_period_s)


class SignsOfLife:
    """The session's end of the pipe. It never waits: a recorder that hangs must not hold up SYNC."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._sign = connection, ALIVE
        os.set_blocking(connection.fileno(), False)

    def alive(self) -> None:
        """The session goes on; after `ended` it can only repeat that."""
        with suppress(OSError):  # full, or nobody reads: the recorder's status tells that
            os.write(self._connection.fileno(), self._sign)

    def ended(self) -> None:
        """Nothing is left to stop: every drive has confirmed, or the session has ended and has reported the others."""
        self._sign = ENDED
        self.alive()

    def stopped(self) -> str:
        """Why the second stop acts, empty while it does not. Known before its first frame can be received."""
        with suppress(OSError):  # nothing to read
            return os.read(self._connection.fileno(), 4096).decode()
        return ""

    def close(self) -> None:
        """Let go of the pipe: without `ended` before, that is taken for the death of the session."""
        self._connection.close()


class DeadMan:
    """The recorder's end: a thread that waits for signs of life, and acts when they stop.

    `events` are (kind, text) for the recording; `reason` says why it acted, None while it has not.
    """

    def __init__(self, connection: Connection, bus: Bus) -> None:
        self._connection, self._bus = connection, bus
        self.events = deque[tuple[int, str, str]]()
        self.reason: str | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> bool:
        """Whether it may still act, or is acting."""
        return self._thread.is_alive()

    def _run(self) -> None:
        reason = self._why()
        if reason is not None:
            self._act(reason)

    def _why(self) -> str | None:
        """Wait until the session is gone or hangs; None where it has ended in order."""
        armed, longest_s = False, silence_s(self._bus.file)
        while True:
            ready, _, _ = select.select([self._connection], [], [], longest_s if armed else None)
            if not ready:
                return f"no sign of life from the session for {longest_s:g} s"
            try:
                signs = os.read(self._connection.fileno(), 65536)
            except OSError:
                signs = b""
            if not signs:
                return "the session's process is gone" if armed else None
            armed = signs.endswith(ALIVE)

    def _act(self, reason: str) -> None:
        self.reason = f"{reason}: the recorder's process stopped the drives"
        with suppress(OSError):  # before the first frame: the session must not take it for another master's
            os.write(self._connection.fileno(), self.reason.encode())
        self._event("fault", self.reason)
        unconfirmed = [drive.node for drive in self._bus.drives]
        try:
            unconfirmed = stop_drives(self._bus)
        except AcquisitionError as error:
            self._event("fault", f"the recorder's process could not stop the drives: {error}")
        if unconfirmed:
            with suppress(OSError, ValueError):  # a closed terminal
                sys.stderr.write(not_disabled(unconfirmed) + "\n")
                sys.stderr.flush()
        text = not_disabled(unconfirmed) if unconfirmed else "every drive confirmed to the recorder's process"
        self._event("not disabled" if unconfirmed else "disabled", text)

    def _event(self, kind: str, text: str) -> None:
        self.events.append((time.time_ns(), kind, text))
