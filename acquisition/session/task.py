"""The task of a session, its stop from outside, and its outcome."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from ..arrays import Array
from ..bus import Master, not_disabled
from ..errors import AcquisitionError
from .recorder import Status


class SessionLog(Protocol):
    """The log of a session as the session uses it; frames reach the log from the link."""

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Record an event."""
        ...

    def poll(self, stamp_ns: int) -> Status | None:
        """A new status of the recorder, or None. Raises `AcquisitionError` when it has ended, or stops the drives."""
        ...

    def alive(self) -> None:
        """Show the second stop that the session is running."""
        ...

    def ended(self) -> None:
        """Disarm the second stop."""
        ...


@dataclass(kw_only=True)
class Stop:
    """Ends a session when `reason` is set from outside (Ctrl-C, SIGTERM); `at_once`: by a quick stop."""

    reason: str = ""
    at_once: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """The task of a session: to record for a time, or to follow a reference.

    Attributes:
        duration_s: of a session without a reference; None: until it is stopped.
        reference: joint positions (N, n), one row per SYNC, rad or m; None: nothing moves.
        place: the name of the reference in errors.
        before_motion: checks the drives before anything is written to them; returns texts for the recording, and raises
            `AcquisitionError` where nothing may move.
    """

    duration_s: float | None = None
    reference: Array | None = None
    place: str = "reference"
    before_motion: Callable[[Master], Iterable[str]] = lambda _: ()


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a session ended.

    Attributes:
        reason: in words.
        fault: whether an error ended it.
        error: the `AcquisitionError` that ended it, with the drive or joint, value and expectation that it names.
        unconfirmed: node ids of commanded drives that did not confirm to be disabled.
        reports: error reports of drives in fault, one line each.
    """

    reason: str
    fault: bool
    error: AcquisitionError | None = None
    unconfirmed: tuple[int, ...] = ()
    reports: tuple[str, ...] = ()

    @property
    def all_disabled(self) -> bool:
        """Whether every commanded drive confirmed."""
        return not self.unconfirmed

    @property
    def alarm(self) -> str:
        """The message that is shown first; empty where every drive confirmed."""
        return not_disabled(self.unconfirmed) if self.unconfirmed else ""
