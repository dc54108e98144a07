"""A bus as frames and times, in real time or in lock-step with simulated drives; a passive link never sends."""

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from ..errors import AcquisitionError
from ..recording import SENT
from ..robot import BusFile
from .bus import is_group, is_no_frame, open_bus, refuse_to_send
from .frame import Frame, Tap, frame_of

ECHOING = ("gs_usb", "cantact")  # modules of python-can whose buses return every frame sent, as not received


class Link:
    """A bus in real time. Where `passive`, sending raises: nothing ever goes out.

    `tap` is called with every frame sent and received.
    """

    def __init__(self, bus: Any, *, passive: bool, tap: Tap | None = None) -> None:
        self._bus, self._passive, self._tap = bus, passive, tap
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        # A multicast group and some adapters give back what was sent: frames on their way back to us.
        echoes = is_group(bus) or type(bus).__module__.split(".")[-1] in ECHOING
        self._own: deque[tuple[int, bytes]] | None = deque(maxlen=1000) if echoes else None

    def now_ns(self) -> int:
        """Time of this link, of events and deadlines: the clock's at its opening, and never set back or forth since."""
        return self._epoch_ns + time.monotonic_ns()

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame. Raises `AcquisitionError` where the link is passive or the bus does not take it."""
        if self._passive:
            refuse_to_send()
        import can

        if self._own is not None:
            self._own.append((can_id, data))
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False), timeout=0.05)
        except can.CanError as error:
            raise AcquisitionError(f"frame 0x{can_id:03X} cannot be sent: {error}", place="bus") from error
        if self._tap is not None:
            self._tap(Frame(self.now_ns(), can_id, data, SENT))

    def receive(self, until_ns: int) -> Frame | None:
        """The next frame, None when there is none until `until_ns`. Raises `AcquisitionError` when the bus fails."""
        return self.take(max(0.0, (until_ns - self.now_ns()) * 1e-9))

    def take(self, timeout_s: float) -> Frame | None:
        """The next frame, None when there is none within `timeout_s`."""
        import can

        until_s = time.monotonic() + timeout_s
        while True:
            try:
                message = self._bus.recv(max(0.0, until_s - time.monotonic()))
            except (can.CanError, OSError) as error:
                if is_no_frame(self._bus, error):
                    if time.monotonic() >= until_s:
                        return None
                    continue
                raise AcquisitionError(f"cannot be read: {error}", place="bus") from error
            if message is None:
                return None
            if getattr(message, "is_fd", False):
                continue
            sent = (message.arbitration_id, bytes(message.data))
            if not self._own or sent not in self._own or (message.is_rx and not is_group(self._bus)):
                break
            self._own.remove(sent)
        frame = frame_of(message)
        if self._tap is not None:
            self._tap(frame)
        return frame

    def close(self) -> None:
        """Leave the bus, also one that has failed."""
        import can

        with suppress(can.CanError, OSError):
            self._bus.shutdown()


class LockStepLink(Link):
    """A link in simulated time on an in-process bus: time advances only when all participants have sent their frames.

    `others(now_ns)` lets the other participants act and returns whether they did; `due_ns()` is when they act by themselves.
    """

    def __init__(
        self,
        bus: Any,
        others: Callable[[int], bool],
        due_ns: Callable[[], int | None],
        *,
        passive: bool,
        tap: Tap | None = None,
        start_ns: int = 1_000_000_000,
    ) -> None:
        super().__init__(bus, passive=passive, tap=tap)
        self._others, self._due_ns, self._time_ns = others, due_ns, start_ns

    def now_ns(self) -> int:
        """Simulated time."""
        return self._time_ns

    def receive(self, until_ns: int) -> Frame | None:
        """As `Link.receive`; simulated time advances only when no participant has a frame to send."""
        while True:
            frame = self.take(0)
            if frame is not None:
                return frame
            if self._others(self._time_ns):
                continue
            due = self._due_ns()
            if self._time_ns >= until_ns:
                return None
            self._time_ns = until_ns if due is None else max(min(until_ns, due), self._time_ns + 1)

    def take(self, timeout_s: float) -> Frame | None:
        """The next frame, with the simulated time."""
        tap, self._tap = self._tap, None
        frame = super().take(0)
        self._tap = tap
        if frame is not None:
            frame = frame._replace(time_ns=self._time_ns)
            if tap is not None:
                tap(frame)
        return frame


def open_link(file: BusFile, *, passive: bool, tap: Tap | None = None) -> Link:
    """A link in real time."""
    return Link(open_bus(file, passive=passive), passive=passive, tap=tap)
