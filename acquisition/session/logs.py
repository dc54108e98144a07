"""The recorder of a session: in its process for simulated time, else in a separate process.

If an interface can be opened only once, the session passes its frames on to the recorder. Otherwise
the recorder opens the bus itself.
"""

import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from ..bus import Frame, block_of
from ..errors import BusFaultError
from ..robot import Payload, Robot
from .process import BLOCK_S, STOPPING, Role, WatchdogPipe, run
from .recorder import RecordedSummary, Recorder, Status

MAX_START_S = 20.0  # of the process
# A long session takes time to decode.
MAX_FINISH_S = 600.0
# After `MAX_SILENT_S` without a status, the disk counts as hung, and less time is left to decode.
MAX_HUNG_FINISH_S = 10.0
MAX_SILENT_S = 5.0

_ENDED = "the recorder's process ended before the session"
OnStatus = Callable[[Status, int], None]  # called with each status, and the time


class InlineLog:
    """A recorder in the process of the session, for simulated time.

    The link calls `tap` with its frames.

    Attributes:
        on_status: called with each status and its time, ns.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder, self._frames = recorder, list[Frame]()
        self.on_status: OnStatus = lambda status, stamp_ns: None

    def tap(self, frame: Frame) -> None:
        """Take a frame that the session sent or received."""
        self._frames.append(frame)

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Record an event at the time `stamp_ns`."""
        self._recorder.event(stamp_ns, kind, text)

    def poll(self, stamp_ns: int) -> Status | None:
        """Write the frames; return a status every half second, else None."""
        if self._frames and stamp_ns - self._frames[0].time_ns >= BLOCK_S * 1e9:
            self._write()
        status = self._recorder.tick(stamp_ns, 0)
        if status is not None:
            self.on_status(status, stamp_ns)
        return status

    def alive(self) -> None:
        """Do nothing, because simulated drives need no watchdog."""

    def ended(self) -> None:
        """Do nothing, as `alive`."""

    def finish(self, stamp_ns: int) -> RecordedSummary:
        """End the recording, and return its summary."""
        self._write()
        self._recorder.tick(stamp_ns, 0, now=True)
        return self._recorder.finish(stamp_ns)

    def close(self) -> None:
        """Close the file as it is."""
        self._recorder.close()

    def _write(self) -> None:
        frames, self._frames = self._frames, []
        self._recorder.add(block_of(frames))


class ProcessLog:
    """A recorder in a separate process.

    Only in the role `FED` the link of the session calls `tap`.

    Attributes:
        on_status: called with each status and its time, ns.
    """

    def __init__(
        self,
        path: Path,
        robot: Robot,
        place: str,
        role: Role,
        offset_ns: int | None = None,
        payload: Payload | None = None,
    ) -> None:
        """Start the process.

        Parameters
        ----------
        path : the recording to write.
        robot : the robot with its bus.
        place : name of the description in errors.
        role : task of the process.
        offset_ns : clock of the session, which its events use, minus the monotonic clock, ns.
        payload : what the robot carries.

        Raises
        ------
        BusFaultError : the process cannot open the bus or the file.
        """
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        # Only the role GUARD reads this pipe.
        watched, watching = context.Pipe()
        self._watchdog_pipe = WatchdogPipe(watching)
        self._frames: list[Frame] = []
        self.on_status: OnStatus = lambda status, stamp_ns: None
        self._process = context.Process(
            target=run,
            args=((other, watched), path.absolute(), dict(robot.files), place, role, payload),
            name="recorder",
            daemon=True,
        )
        # A Ctrl-C of the whole group must not end the process before it ignores signals, so they
        # are blocked while it starts. The first start of the resource tracker would unblock them.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        other.close()
        watched.close()
        if offset_ns is not None:
            self._send(("clock", offset_ns))
        self._expect("ready", MAX_START_S)
        self._heard_s, self._hangs = time.monotonic(), False

    def tap(self, frame: Frame) -> None:
        """Take a frame that the session sent or received."""
        self._frames.append(frame)

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Record an event at the time `stamp_ns`."""
        self._send(("event", stamp_ns, kind, text))

    def granted(self, counters: dict[str, float]) -> None:
        """Record the scheduling that the system granted to the session, in `/health`."""
        self._send(("granted", counters))

    def alive(self) -> None:
        """Send a heartbeat to the watchdog.

        Only the SYNC loop may call this: a helper thread would keep sending after the loop has
        hung.
        """
        self._watchdog_pipe.alive()

    def ended(self) -> None:
        """Disarm the watchdog."""
        self._watchdog_pipe.ended()

    def poll(self, stamp_ns: int) -> Status | None:
        """Return the latest status; None if there is no new one.

        The SYNC loop calls this at every SYNC, which is also a heartbeat to the watchdog.

        Raises
        ------
        BusFaultError : the recorder has ended, hangs, or stops the drives.
        """
        self.alive()
        if reason := self._watchdog_pipe.stopped():
            raise BusFaultError(reason)
        if self._frames and stamp_ns - self._frames[0].time_ns >= BLOCK_S * 1e9:
            self._hand_over()
        status = None
        for kind, content in self._messages(until_s=0.0):
            status = content if kind == "status" else status
        if status is not None:
            self._heard_s = time.monotonic()
            self.on_status(status, stamp_ns)
        silent_s = time.monotonic() - self._heard_s
        self._hangs = silent_s > MAX_SILENT_S
        if self._hangs:
            raise BusFaultError(
                f"the recorder has sent no status for {silent_s:.1f} s, instead of every 0.5 s"
            )
        return status

    def finish(self, stamp_ns: int) -> RecordedSummary:
        """End the recording, and return its summary.

        Raises
        ------
        BusFaultError : the recorder has ended before, or does not finish in time.
        """
        self.ended()
        if self._frames:
            self._hand_over()
        self._send(("stop", stamp_ns))
        found: RecordedSummary = self._expect(
            "done", MAX_HUNG_FINISH_S if self._hangs else MAX_FINISH_S
        )
        self._process.join(5)
        return found

    def close(self) -> None:
        """Disconnect from the process, which then closes its file."""
        self._watchdog_pipe.close()
        self._connection.close()
        self._process.join(30)

    def _hand_over(self) -> None:
        frames, self._frames = self._frames, []
        self._send(("frames", block_of(frames).tobytes()))

    def _send(self, message: tuple[Any, ...]) -> None:
        try:
            self._connection.send(message)
        except OSError as error:
            raise BusFaultError(_ENDED) from error

    def _expect(self, wanted: str, timeout_s: float) -> Any:
        for kind, content in self._messages(until_s=time.monotonic() + timeout_s):
            if kind == wanted:
                return content
        raise BusFaultError(f"the recorder did not report {wanted!r} within {timeout_s:g} s")

    def _messages(self, until_s: float) -> Iterator[tuple[str, Any]]:
        """Yield what the process sends, by kind, until a monotonic time."""
        try:
            while self._connection.poll(max(0.0, until_s - time.monotonic())):
                kind, content = self._connection.recv()
                if kind == "failed":
                    raise BusFaultError(content)
                yield kind, content
        except (EOFError, OSError) as error:
            raise BusFaultError(_ENDED) from error


SessionLog = InlineLog | ProcessLog
