"""What a session is asked to do, how it is stopped from outside, and how it ended."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from ..arrays import Array
from ..master import (
    Master,
    not_disabled,
)
from ..recorder import Status


class SessionLog(Protocol):
    """Where a session writes down what happens; the frames come to it by themselves."""

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Note what happened."""
        ...

    def poll(self, stamp_ns: int) -> Status | None:
        """Latest news of the recorder, None when there are none. Raises `AcquisitionError` when it has ended."""
        ...


@dataclass(kw_only=True)
class Stop:
    """Set from outside (Ctrl-C, SIGTERM) to end a session in order; `at_once` by a quick stop."""

    reason: str = ""
    at_once: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """What a session does: for how long, and along which joint positions (N, n), one row each SYNC.

    `before_motion` looks at the drives before anything is written to them; it returns what is to be noted, and raises
    `AcquisitionError` where nothing may move.
    """

    duration_s: float | None = None
    reference: Array | None = None
    place: str = "reference"
    before_motion: Callable[[Master], Iterable[str]] = lambda _: ()


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a session ended: in order or by a fault, and which drives that were addressed did not confirm to be disabled.

    `reports` are the error reports of drives in fault, one line each.
    """

    reason: str
    fault: bool
    unconfirmed: tuple[int, ...] = ()
    reports: tuple[str, ...] = ()

    @property
    def all_disabled(self) -> bool:
        """Whether every drive that was addressed confirmed."""
        return not self.unconfirmed

    @property
    def alarm(self) -> str:
        """The message to be shown first, empty where every drive confirmed."""
        return not_disabled(self.unconfirmed) if self.unconfirmed else ""
