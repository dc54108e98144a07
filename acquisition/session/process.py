"""The recorder's process, with the watchdog that stops the drives if a session dies or hangs.

Only the SYNC loop of the session sends heartbeats to the watchdog, through a pipe at every SYNC.
The first heartbeat arms the watchdog. Only a session that ends in order disarms it. When the pipe
ends or a heartbeat is missing, the watchdog opens the bus for sending and calls `stop_drives`.
"""

import os
import select
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import closing, suppress
from enum import Enum
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ..arrays import Ints
from ..bus import (
    Receiver,
    WallClock,
    command_ids,
    describe_step,
    kernel_drops,
    not_disabled,
    open_bus,
    stop_drives,
)
from ..errors import BusFaultError, RobotIdimError
from ..protocol import HEARTBEAT
from ..recording import FRAME, SENT
from ..robot import Bus, BusFile, Payload, Robot, resolve, robot_from_files
from .recorder import RecordedSummary, Recorder

BLOCK_S = 0.1
# The session's process handles these signals.
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
# The watchdog timeout is the longer of this time and so many SYNC periods.
SILENT_S = 0.3
SILENT_PERIODS = 3
ALIVE, ENDED = b"\1", b"\0"


def silence_s(file: BusFile) -> float:
    """Return the watchdog timeout in s.

    After so long without a heartbeat, the session counts as hung.
    """
    return max(SILENT_S, SILENT_PERIODS * file.sync_period_s)


class WatchdogPipe:
    """The end of the watchdog's pipe in the session.

    It never blocks, because a recorder that hangs must not delay SYNC.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection, self._sign = connection, ALIVE
        os.set_blocking(connection.fileno(), False)

    def alive(self) -> None:
        """Send a heartbeat; after `ended`, send the end instead."""
        # The pipe is full, or not read any more. Then the status of the recorder is missing, too.
        with suppress(OSError):
            os.write(self._connection.fileno(), self._sign)

    def ended(self) -> None:
        """Disarm the watchdog.

        Every drive has confirmed, or the session has ended and reported the others.
        """
        self._sign = ENDED
        self.alive()

    def stopped(self) -> str:
        """Return why the watchdog acts; empty if it does not.

        The text is sent before the first frame of the watchdog can be received.
        """
        # There is nothing to read.
        with suppress(OSError):
            return os.read(self._connection.fileno(), 4096).decode()
        return ""

    def close(self) -> None:
        """Close the pipe. Without `ended` before, this counts as the death of the session."""
        self._connection.close()


class Watchdog:
    """The end of the pipe in the recorder's process: a thread that stops the drives.

    It waits for heartbeats, and acts if they are missing.

    Attributes:
        events: events for the recording.
        reason: why it has stopped the drives; None if it has not.
    """

    def __init__(self, connection: Connection, bus: Bus) -> None:
        self._connection, self._bus = connection, bus
        self.events = deque[tuple[int, str, str]]()  # time, kind and text for the recording
        self.reason: str | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> bool:
        """True while it may still stop the drives, or is stopping them."""
        return self._thread.is_alive()

    def _run(self) -> None:
        if (reason := self._wait_for_failure()) is not None:
            self._stop_drives(reason)

    def _wait_for_failure(self) -> str | None:
        """Wait until the session has died or hangs, and return why.

        The result is None if the session has ended in order.
        """
        armed, longest_s = False, silence_s(self._bus.file)
        while True:
            ready, _, _ = select.select([self._connection], [], [], longest_s if armed else None)
            if not ready:
                return f"the session has sent no heartbeat for {longest_s:g} s"
            try:
                signs = os.read(self._connection.fileno(), 65536)
            except OSError:
                signs = b""
            if not signs:
                return "the session's process has ended" if armed else None
            armed = signs.endswith(ALIVE)

    def _stop_drives(self, reason: str) -> None:
        self.reason = f"{reason}: the watchdog stopped the drives"
        # The session needs the reason before the first frame, which it would otherwise attribute to
        # another master.
        with suppress(OSError):
            os.write(self._connection.fileno(), self.reason.encode())
        self._event("fault", self.reason)
        unconfirmed = [drive.node for drive in self._bus.drives]
        try:
            unconfirmed = stop_drives(self._bus)
        # Whatever the error is, the drives that may be enabled must be named.
        except Exception as error:
            self._event("fault", f"the watchdog could not stop the drives: {error}")
        if unconfirmed:
            # The terminal may be closed.
            with suppress(OSError, ValueError):
                sys.stderr.write(not_disabled(unconfirmed) + "\n")
                sys.stderr.flush()
            self._event("not disabled", not_disabled(unconfirmed))
        else:
            self._event("disabled", "every drive confirmed to the watchdog")

    def _event(self, kind: str, text: str) -> None:
        self.events.append((time.time_ns(), kind, text))


class Role(Enum):
    """The task of the recorder's process. In all roles but `LISTENER` the session is the master.

    `LISTENER` and `OBSERVER` open the bus and only receive. `GUARD` is also the watchdog. `FED`
    gets the frames from the session, because the interface can be opened only once.
    """

    LISTENER = "passive"
    OBSERVER = "observer"
    GUARD = "guard"
    FED = "fed"


def run(
    pipes: tuple[Connection, Connection],
    path: Path,
    files: Mapping[str, bytes],
    place: str,
    role: Role,
    payload: Payload | None,
) -> None:
    """Run the recorder's process.

    It ignores signals such as Ctrl-C. It ends on request, or after the session has died.

    Parameters
    ----------
    pipes : pipe to the session, and pipe of its heartbeats.
    path : the recording to write.
    files : files of the robot description, by name.
    place : name of the description in errors.
    role : task of the process.
    payload : what the robot carries.
    """
    connection, watched = pipes
    # Ctrl-Z halts the session, but its watchdog must still run.
    for number in (*STOPPING, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)
    bus = None
    try:
        robot = robot_from_files(files, place)
        assert robot.bus is not None
        # The recorder never sends; the watchdog opens the bus again if it must stop the drives.
        bus = None if role is Role.FED else open_bus(robot.bus, passive=True)
        recorder = Recorder(
            path,
            robot,
            source="CAN, passive" if role is Role.LISTENER else "CAN, active",
            place=place,
            payload=payload,
        )
        receiver = None if bus is None else Receiver(bus)
        with closing(recorder):
            ours = np.zeros(0, np.int64) if role is Role.LISTENER else _master_ids(robot, place)
            watchdog = Watchdog(watched, resolve(robot, place)) if role is Role.GUARD else None
            done = _record(connection, recorder, receiver, ours, watchdog)
        connection.send(("done", done))
    except (RobotIdimError, OSError) as error:
        with suppress(OSError):
            connection.send(
                (
                    "failed",
                    str(error)
                    if isinstance(error, RobotIdimError)
                    else f"{path}: the recording cannot be written: {error.strerror}",
                )
            )
    finally:
        if bus is not None:
            bus.shutdown()


def _master_ids(robot: Robot, place: str) -> Ints:
    """Return the identifiers of frames that only this program sends in an active session."""
    bus = resolve(robot, place)
    return np.array(
        [
            HEARTBEAT + bus.file.master_node,
            *([bus.file.sync_can_id] if bus.file.sync_producer == "recorder" else []),
            *command_ids(bus),
        ]
    )


def _record(
    connection: Connection,
    recorder: Recorder,
    receiver: Receiver | None,
    ours: Ints,
    watchdog: Watchdog | None,
) -> RecordedSummary:
    """Record until the session requests the end, or has died and its drives are stopped."""
    thread = threading.Thread(target=receiver.run, daemon=True) if receiver is not None else None
    if thread is not None:
        thread.start()
    connection.send(("ready", None))
    stop_ns, gone = None, False
    # This clock is used until that of the session is known.
    clock = WallClock()
    while stop_ns is None:
        try:
            if connection.poll(BLOCK_S):
                match connection.recv():
                    case "event", stamp_ns, kind, text:
                        recorder.event(stamp_ns, kind, text)
                    case "clock", offset_ns:
                        clock = WallClock(offset_ns=offset_ns)
                    case "frames", data:
                        block = np.frombuffer(data, FRAME).copy()
                        _note_step(recorder, clock)
                        # Frames that the session sent have its time already.
                        received = (block["flags"] & SENT) == 0
                        block["time_ns"][received] = clock.continued(block["time_ns"][received])
                        recorder.add(block)
                    case "granted", counters:
                        recorder.granted = counters
                    case "stop", asked_ns:
                        stop_ns = asked_ns
        except (EOFError, OSError):
            if not gone:
                recorder.event(clock.now_ns(), "fault", "the session's process has ended")
            gone = True
            if watchdog is None or not watchdog.waiting:
                stop_ns = clock.now_ns()
            else:
                # The pipe of a session that has ended is always ready, so that `poll` never waits.
                time.sleep(BLOCK_S / 5)
        if watchdog is not None:
            while watchdog.events:
                stamp_ns, kind, text = watchdog.events.popleft()
                recorder.event(stamp_ns - clock.shift_ns, kind, text)
        if receiver is not None and thread is not None:
            if stop_ns is not None:
                receiver.stopped = True
                thread.join(2 * Receiver.DRAIN_S)
            block = receiver.take()
            _note_step(recorder, clock)
            block["time_ns"] = clock.continued(block["time_ns"])
            # The kernel marks frames that any program of this computer sent, but SENT means sent by
            # this session.
            block["flags"] &= 0xFF ^ SENT
            block["flags"][np.isin(block["can_id"], ours)] |= SENT
            recorder.add(block)
            if receiver.error is not None:
                recorder.event(clock.now_ns(), "fault", f"bus: reading failed: {receiver.error}")
                raise BusFaultError(f"reading failed: {receiver.error}", place="bus")
        status = recorder.tick(
            clock.now_ns(), kernel_drops(receiver.sock) if receiver is not None else 0
        )
        if status is not None:
            # If the session has died, the next `poll` finds it out.
            with suppress(OSError):
                connection.send(("status", status))
    return recorder.finish(stop_ns)


def _note_step(recorder: Recorder, clock: WallClock) -> None:
    """Record that the computer's clock was set.

    This is called after frames from before and after the step were taken.
    """
    if step_ns := clock.step_ns():
        recorder.event(
            clock.now_ns(), "mark", f"{describe_step(step_ns)}; recorded times ignore this step"
        )
