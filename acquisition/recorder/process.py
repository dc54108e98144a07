"""The recorder as a process of its own: it receives, appends and writes, independent of the load of the session's process.

Where an interface can be opened once only, the session hands its frames over; else the recorder opens the bus itself.
"""

import multiprocessing
import signal
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import AcquisitionError
from ..master import HEARTBEAT_ID
from ..protocol import REQUEST
from ..recording import FRAME, SENT
from ..robot import Robot, resolve, robot_from_files
from ..transport import DRAIN_S, Frame, Receiver, WallClock, block_of, describe_step, kernel_drops, open_bus
from .dead_man import DeadMan, SignsOfLife
from .recorder import Recorded, Recorder, Status

BLOCK_S = 0.1
START_S = 20.0  # for the process to come up
FINISH_S = 600.0  # to decode a long session
HUNG_FINISH_S = 10.0  # for one without a status for long
SILENT_S = 5.0  # without a status for so long the disk is taken to hang
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)  # handled by the session's process


class InlineLog:
    """A recorder in the session's own process, for simulated time: `tap` takes the link's frames."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder, self._frames = recorder, list[Frame]()

    def tap(self, frame: Frame) -> None:
        """A frame sent or received."""
        self._frames.append(frame)

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Note what happened."""
        self._recorder.event(stamp_ns, kind, text)

    def poll(self, stamp_ns: int) -> Status | None:
        """Write what came; a status every half second."""
        if self._frames and stamp_ns - self._frames[0].time_ns >= BLOCK_S * 1e9:
            self._write()
        return self._recorder.tick(stamp_ns, 0)

    def finish(self, stamp_ns: int) -> Recorded:
        """End the recording."""
        self._write()
        self._recorder.tick(stamp_ns, 0, now=True)
        return self._recorder.finish(stamp_ns)

    def close(self) -> None:
        """End the file as it is."""
        self._recorder.close()

    def _write(self) -> None:
        frames, self._frames = self._frames, []
        self._recorder.add(block_of(frames))


class ProcessLog:
    """A recorder in a process of its own. With `feed` the session's link must be tapped by `tap`.

    Raises `AcquisitionError` where the process cannot open the bus or the file.
    """

    def __init__(
        self, path: Path, robot: Robot, *, source: str, place: str, feed: bool, passive: bool, dead_man: bool = False
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        watched, signs = context.Pipe() if dead_man else (None, None)
        self._signs = None if signs is None else SignsOfLife(signs)
        self._frames: list[Frame] | None = [] if feed else None
        arguments = (other, str(path.absolute()), dict(robot.files), source, place, feed, passive, watched)
        self._process = context.Process(target=_main, args=arguments, name="recorder", daemon=True)
        # Blocked while it starts: a Ctrl-C of the whole group must not meet it before it ignores them.
        resource_tracker.ensure_running()  # it would unblock them on its own first start
        before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        other.close()
        if watched is not None:
            watched.close()
        self._expect("ready", START_S)
        self._heard_s, self._hangs = time.monotonic(), False

    @property
    def pid(self) -> int | None:
        """Process id of the recorder."""
        return self._process.pid

    def tap(self, frame: Frame) -> None:
        """A frame sent or received by the session, where it feeds the recorder."""
        if self._frames is not None:
            self._frames.append(frame)

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Note what happened."""
        self._send(("event", stamp_ns, kind, text))

    def granted(self, counters: dict[str, float]) -> None:
        """What the session's process was granted, for `/health`."""
        self._send(("granted", counters))

    def poll(self, stamp_ns: int) -> Status | None:
        """Latest status, None when there is none. Raises `AcquisitionError` when the recorder has ended, or hangs.

        With a dead man this shows that the session is running: to be called at every SYNC, by the SYNC loop alone.
        """
        if self._signs is not None:
            self._signs.alive()
        if self._frames and stamp_ns - self._frames[0].time_ns >= BLOCK_S * 1e9:
            self._hand_over()
        status = None
        try:
            while self._connection.poll():
                kind, content = self._connection.recv()
                if kind in ("failed", "stopped"):
                    raise AcquisitionError(content)
                status = content if kind == "status" else status
        except (EOFError, OSError) as error:
            raise AcquisitionError("the recorder has ended: expected it to go on until the session ends") from error
        if status is not None:
            self._heard_s = time.monotonic()
        silent_s = time.monotonic() - self._heard_s
        self._hangs = silent_s > SILENT_S
        if self._hangs:
            raise AcquisitionError(f"the recorder tells nothing for {silent_s:.1f} s: expected news every 0.5 s")
        return status

    def finish(self, stamp_ns: int) -> Recorded:
        """End the recording. Raises `AcquisitionError` when the recorder has ended before."""
        if self._signs is not None:
            self._signs.ended()
        if self._frames:
            self._hand_over()
        self._send(("stop", stamp_ns))
        found = self._expect("done", HUNG_FINISH_S if self._hangs else FINISH_S)
        self._process.join(5)
        assert isinstance(found, Recorded)
        return found

    def close(self) -> None:
        """Disconnect from the process, which then ends its file by itself."""
        if self._signs is not None:
            self._signs.close()
        self._connection.close()
        self._process.join(30)

    def _hand_over(self) -> None:
        frames, self._frames = self._frames or [], []
        self._send(("frames", block_of(frames).tobytes()))

    def _send(self, message: tuple[Any, ...]) -> None:
        try:
            self._connection.send(message)
        except OSError as error:
            raise AcquisitionError("the recorder has ended: expected it to go on until the session ends") from error

    def _expect(self, wanted: str, timeout_s: float) -> Any:
        until_s = time.monotonic() + timeout_s
        try:
            while self._connection.poll(max(0.0, until_s - time.monotonic())):
                kind, content = self._connection.recv()
                if kind == "failed":
                    raise AcquisitionError(content)
                if kind == wanted:
                    return content
        except (EOFError, OSError) as error:
            raise AcquisitionError("the recorder has ended: expected it to go on until the session ends") from error
        raise AcquisitionError(f"the recorder did not answer in {timeout_s:g} s: expected {wanted}")


def _main(
    connection: Connection,
    path: str,
    files: Mapping[str, bytes],
    source: str,
    place: str,
    feed: bool,
    passive: bool,
    watched: Connection | None,
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
        bus = None if feed else open_bus(robot.bus, passive=True)
        recorder = Recorder(Path(path), robot, source=source, place=place)
        receiver = None if bus is None else Receiver(bus)
        try:
            ours = np.zeros(0, np.int64) if passive else _master_ids(robot, place)
            dead_man = None if watched is None or passive else DeadMan(watched, resolve(robot, place))
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


def _master_ids(robot: Robot, place: str) -> NDArray[np.int64]:
    """Identifiers that only the master sends: in an active session these frames are ours."""
    bus = resolve(robot, place)
    ids = [0, HEARTBEAT_ID + bus.file.master_node] + [bus.file.sync_can_id] * (bus.file.sync_producer == "recorder")
    for drive in bus.drives:
        ids += [REQUEST + drive.node, *(pdo.can_id for pdo in drive.rpdos)]
    return np.array(ids)


def _record(
    connection: Connection,
    recorder: Recorder,
    receiver: Receiver | None,
    ours: NDArray[np.int64],
    dead_man: DeadMan | None,
) -> Recorded | None:
    """Record until the session asks to stop, or has died and its drives are stopped."""
    thread = threading.Thread(target=receiver.run, daemon=True) if receiver is not None else None
    if thread is not None:
        thread.start()
    connection.send(("ready", None))
    stop_ns, gone, reported = None, False, False
    clock = WallClock()
    while stop_ns is None:
        try:
            if connection.poll(BLOCK_S):
                message = connection.recv()
                if message[0] == "event":
                    recorder.event(*message[1:])
                elif message[0] == "frames":
                    recorder.add(np.frombuffer(message[1], FRAME))
                elif message[0] == "granted":
                    recorder.granted = message[1]
                elif message[0] == "stop":
                    stop_ns = message[1]
        except (EOFError, OSError):
            if not gone:
                recorder.event(time.time_ns(), "fault", "the session's process is gone")
            gone = True
            if dead_man is None or not dead_man.waiting:
                stop_ns = time.time_ns()
            else:
                time.sleep(BLOCK_S / 5)  # the pipe of a session that is gone is always ready
        if dead_man is not None:
            while dead_man.events:
                recorder.event(*dead_man.events.popleft())
            if dead_man.reason is not None and not reported:
                reported = True
                with suppress(OSError):
                    connection.send(("stopped", dead_man.reason))
        if receiver is not None:
            if stop_ns is not None:
                receiver.stopped = True
                assert thread is not None
                thread.join(2 * DRAIN_S)
            block = receiver.take()
            # The kernel marks what any program of this machine sent; here it counts who we are.
            by_us = np.where(np.isin(block["can_id"], ours), SENT, 0)
            block["flags"] = (block["flags"] & (0xFF ^ SENT)) | by_us
            recorder.add(block)
            if receiver.error is not None:
                recorder.event(time.time_ns(), "fault", f"bus: cannot be read: {receiver.error}")
                raise AcquisitionError(f"bus: cannot be read: {receiver.error}")
        if step_ns := clock.step_ns():
            recorder.event(time.time_ns(), "mark", describe_step(step_ns))
        status = recorder.tick(time.time_ns(), kernel_drops(receiver.sock) if receiver is not None else 0)
        if status is not None:
            try:
                connection.send(("status", status))
            except OSError:
                continue  # the next `poll` finds the session dead
    return recorder.finish(stop_ns)
