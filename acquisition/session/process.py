"""The recorder's process: it receives, appends and writes, independent of the load of the session's process."""

import signal
import threading
import time
from collections.abc import Mapping
from enum import Enum
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ..arrays import Ints
from ..bus import DRAIN_S, Receiver, WallClock, command_ids, describe_step, kernel_drops, open_bus
from ..errors import AcquisitionError
from ..protocol import HEARTBEAT
from ..recording import FRAME, SENT
from ..robot import Robot, resolve, robot_from_files
from .dead_man import DeadMan
from .recorder import Recorded, Recorder

BLOCK_S = 0.1
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)  # handled by the session's process


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
    for number in (*STOPPING, signal.SIGTSTP):  # Ctrl-Z halts the session: its dead man must go on
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)
    bus = None
    try:
        robot = robot_from_files(files, place)
        assert robot.bus is not None
        # What records never sends; a dead man opens the bus once more, when it has to.
        bus = None if role is Role.FED else open_bus(robot.bus, passive=True)
        source = "CAN, passive" if role is Role.LISTENER else "CAN, active"
        recorder = Recorder(path, robot, source=source, place=place)
        receiver = None if bus is None else Receiver(bus)
        try:
            ours = np.zeros(0, np.int64) if role is Role.LISTENER else _master_ids(robot, place)
            dead_man = None if watched is None else DeadMan(watched, resolve(robot, place))
            done = _record(connection, recorder, receiver, ours, dead_man)
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
    connection: Connection, recorder: Recorder, receiver: Receiver | None, ours: Ints, dead_man: DeadMan | None
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
            if dead_man is None or not dead_man.waiting:
                stop_ns = clock.now_ns()
            else:
                time.sleep(BLOCK_S / 5)  # the pipe of a session that is gone is always ready
        if dead_man is not None:
            while dead_man.events:
                stamp_ns, kind, text = dead_man.events.popleft()
                recorder.event(stamp_ns - clock.shift_ns, kind, text)
        if receiver is not None:
            if stop_ns is not None:
                receiver.stopped = True
                assert thread is not None
                thread.join(2 * DRAIN_S)
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
