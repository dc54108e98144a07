"""The recorder's process: it receives, appends and writes, and stops the drives of a session that dies or hangs in motion.

The session sends a sign of life through a pipe at every SYNC, from its SYNC loop alone. The first one arms; only a session
that has ended in order disarms. When the pipe ends or stays silent, the bus is opened for sending and `stop_drives` runs.
"""

import os
import select
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from enum import Enum
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ..arrays import Ints
from ..bus import Receiver, WallClock, command_ids, describe_step, kernel_drops, not_disabled, open_bus, stop_drives
from ..errors import AcquisitionError
from ..protocol import HEARTBEAT
from ..recording import FRAME, SENT
from ..robot import Bus, BusFile, Robot, resolve, robot_from_files
from .recorder import Recorded, Recorder

BLOCK_S = 0.1
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)  # handled by the session's process
SILENT_S = 0.3
SILENT_PERIODS = 3  # of SYNC, where they are longer
ALIVE, ENDED = b"\1", b"\0"


def silence_s(file: BusFile) -> float:
    """Time without a sign of life after which the session counts as hung."""
    return max(SILENT_S, SILENT_PERIODS * file.sync_period_s)


class WatchdogPipe:
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


class Watchdog:
    """The recorder's end: a thread that waits for signs of life, and acts when they stop."""

    def __init__(self, connection: Connection, bus: Bus) -> None:
        self._connection, self._bus = connection, bus
        self.events = deque[tuple[int, str, str]]()  # stamp, kind and text for the recording
        self.reason: str | None = None  # why it acted
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> bool:
        """Whether it may still act, or is acting."""
        return self._thread.is_alive()

    def _run(self) -> None:
        if (reason := self._why()) is not None:
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


class Role(Enum):
    """What the recorder's process does in a session; all but `LISTENER` in one whose master is ours.

    `LISTENER` and `OBSERVER` open the bus and only receive. `GUARD` does so too, and stops the drives when the session dies
    or hangs. `FED` is handed the frames, where the interface can be opened once only.
    """

    LISTENER = "passive"
    OBSERVER = "observer"
    GUARD = "guard"
    FED = "fed"


def run(
    connection: Connection, path: Path, files: Mapping[str, bytes], place: str, role: Role, watched: Connection | None
) -> None:
    """The recorder's process. Signals such as Ctrl-C are ignored here; the session ends it, or its death does."""
    for number in (*STOPPING, signal.SIGTSTP):  # Ctrl-Z halts the session: its watchdog must go on
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)
    bus = None
    try:
        robot = robot_from_files(files, place)
        assert robot.bus is not None
        # What records never sends; a watchdog opens the bus once more, when it has to.
        bus = None if role is Role.FED else open_bus(robot.bus, passive=True)
        source = "CAN, passive" if role is Role.LISTENER else "CAN, active"
        recorder = Recorder(path, robot, source=source, place=place)
        receiver = None if bus is None else Receiver(bus)
        try:
            ours = np.zeros(0, np.int64) if role is Role.LISTENER else _master_ids(robot, place)
            watchdog = None if watched is None else Watchdog(watched, resolve(robot, place))
            done = _record(connection, recorder, receiver, ours, watchdog)
        finally:
            recorder.close()
        if done is not None:
            connection.send(("done", done))
    except (AcquisitionError, OSError) as error:
        problem = str(error) if isinstance(error, AcquisitionError) else f"{path}: cannot be written: {error.strerror}"
        try:
            connection.send(("failed", problem))
        except OSError:
            return
    finally:
        if bus is not None:
            bus.shutdown()


def _master_ids(robot: Robot, place: str) -> Ints:
    """Identifiers that only the master sends: in an active session these frames are ours."""
    bus = resolve(robot, place)
    ids = [HEARTBEAT + bus.file.master_node] + [bus.file.sync_can_id] * (bus.file.sync_producer == "recorder")
    return np.array([*ids, *command_ids(bus)])


def _record(
    connection: Connection, recorder: Recorder, receiver: Receiver | None, ours: Ints, watchdog: Watchdog | None
) -> Recorded | None:
    """Record until the session asks to stop, or has died and its drives are stopped."""
    thread = threading.Thread(target=receiver.run, daemon=True) if receiver is not None else None
    if thread is not None:
        thread.start()
    connection.send(("ready", None))
    stop_ns, gone = None, False
    clock = WallClock()  # until the session's is known
    while stop_ns is None:
        try:
            if connection.poll(BLOCK_S):
                message = connection.recv()
                if message[0] == "event":
                    recorder.event(*message[1:])
                elif message[0] == "clock":
                    clock = WallClock(offset_ns=message[1])
                elif message[0] == "frames":
                    block = np.frombuffer(message[1], FRAME).copy()
                    _note_step(recorder, clock)
                    received = (block["flags"] & SENT) == 0  # what the session sends has the session's own time
                    block["time_ns"][received] = clock.continued(block["time_ns"][received])
                    recorder.add(block)
                elif message[0] == "granted":
                    recorder.granted = message[1]
                elif message[0] == "stop":
                    stop_ns = message[1]
        except (EOFError, OSError):
            if not gone:
                recorder.event(clock.now_ns(), "fault", "the session's process is gone")
            gone = True
            if watchdog is None or not watchdog.waiting:
                stop_ns = clock.now_ns()
            else:
                time.sleep(BLOCK_S / 5)  # the pipe of a session that is gone is always ready
        if watchdog is not None:
            while watchdog.events:
                stamp_ns, kind, text = watchdog.events.popleft()
                recorder.event(stamp_ns - clock.shift_ns, kind, text)
        if receiver is not None:
            if stop_ns is not None:
                receiver.stopped = True
                assert thread is not None
                thread.join(2 * Receiver.DRAIN_S)
            block = receiver.take()
            _note_step(recorder, clock)
            block["time_ns"] = clock.continued(block["time_ns"])
            # The kernel marks what any program of this machine sent; here it counts who we are.
            by_us = np.where(np.isin(block["can_id"], ours), SENT, 0)
            block["flags"] = (block["flags"] & (0xFF ^ SENT)) | by_us
            recorder.add(block)
            if receiver.error is not None:
                recorder.event(clock.now_ns(), "fault", f"bus: cannot be read: {receiver.error}")
                raise AcquisitionError(f"cannot be read: {receiver.error}", place="bus")
        status = recorder.tick(clock.now_ns(), kernel_drops(receiver.sock) if receiver is not None else 0)
        if status is not None:
            try:
                connection.send(("status", status))
            except OSError:
                continue  # the next `poll` finds the session dead
    return recorder.finish(stop_ns)


def _note_step(recorder: Recorder, clock: WallClock) -> None:
    """Record that the computer's clock was set, after frames were taken: those before and after it are there."""
    if step_ns := clock.step_ns():
        recorder.event(clock.now_ns(), "mark", f"{describe_step(step_ns)}: times go on as if it had not been")
