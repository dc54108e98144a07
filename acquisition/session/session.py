"""The loop of a session: configure the drives and record, or enable, approach, track and stop.

Nothing moves unless the task has a reference. However a session ends, all drives that it commanded
are disabled in `finally`, and the recording shows which of them confirmed it.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from .. import bus
from ..arrays import Array
from ..errors import BusFaultError, HeldBack, RobotIdimError
from ..protocol import DISABLED, Command, State, notices
from ..robot import (
    Drive,
    Robot,
    approach,
    check_carriers,
    check_limits,
    follow,
    refuse_out_of_range,
)
from .logs import SessionLog
from .motion import MotionState, all_enabled, disable, enable, joint_fault, node_fault, state_fault
from .timing import Pace

# The drives hold their position for so long at the end of motion, before they are disabled.
HOLD_S = 0.3


@dataclass(kw_only=True)
class Stop:
    """A stop of a session.

    Attributes:
        reason: why the session is stopped (Ctrl-C, SIGTERM); empty while it runs.
        at_once: True for a quick stop.
    """

    reason: str = ""
    at_once: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """The task of a session: to record for a time, or to follow a reference.

    Without a reference nothing moves.

    Attributes:
        duration_s: duration of a session without a reference, s; None until it is stopped.
        reference: joint positions (N, n), one row per SYNC, rad or m.
        place: name of the reference in errors.
        before_motion: checks the drives before anything is written to them. It returns texts for
            the recording, or raises `RobotIdimError` if nothing may move.
        notes: returns new notes of the operator.
    """

    duration_s: float | None = None
    reference: Array | None = None
    place: str = "reference"
    before_motion: Callable[[bus.Master], Iterable[str]] = lambda _: ()
    notes: Callable[[], Iterable[str]] = tuple


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The end of a session.

    Attributes:
        reason: why the session ended.
        fault: True if an error ended it.
        cut_short: True if a reference was not followed to its end, or if the recorder had to end.
        error: the error that ended the session; None without one.
        unconfirmed: node ids of commanded drives that did not confirm that they are disabled.
        reports: error reports of drives in fault, one line each.
    """

    reason: str
    fault: bool
    cut_short: bool = False
    error: RobotIdimError | None = None
    unconfirmed: tuple[int, ...] = ()
    reports: tuple[str, ...] = ()

    @property
    def alarm(self) -> str:
        """Message that is shown first; empty if every drive confirmed."""
        return bus.not_disabled(self.unconfirmed) if self.unconfirmed else ""


def run_active(
    robot: Robot,
    master: bus.Master,
    log: SessionLog,
    task: Task,
    stop: Stop,
    announce: Callable[[Outcome], None] = lambda _: None,
) -> Outcome:
    """Configure the drives, send SYNC and record; follow the reference of the task if it has one.

    Without a reference nothing moves.

    A `RobotIdimError` that ends the session is not raised. Any other exception is raised after the
    drives were disabled. An exception while they are stopped, also of `log` or `announce`, is held
    back until then. Unless it is an interrupt (KeyboardInterrupt, SystemExit), it is only recorded.

    Parameters
    ----------
    robot : the robot, with its drives.
    master : has an open link that may send.
    log : gets the frames of the link independently.
    task : the reference, or a duration.
    stop : ends the session when set from outside (Ctrl-C).
    announce : called with the outcome as soon as it is known, also if an exception follows.

    Returns
    -------
    The outcome, with the `RobotIdimError` that ended the session as its `error`.
    """
    session = _Session(robot, master, log, task, stop)
    reason, fault = "", True
    failure: RobotIdimError | None = None
    try:
        session.prepare()
        session.phases()
        reason, fault = stop.reason or "finished", False
    except RobotIdimError as error:
        reason, failure = str(error), error
    except BaseException as error:
        reason = f"{type(error).__name__}: {error}"
        raise
    finally:
        held = session.held
        # Drives must be disabled even if the recorder has ended.
        with held:
            session.note("fault" if fault else "end", reason)
        unconfirmed = [drive.node for drive in master.bus.drives]
        with held:
            unconfirmed = session.make_safe()
        outcome = Outcome(
            reason=reason,
            fault=fault,
            cut_short=session.cut_short,
            error=failure,
            unconfirmed=tuple(unconfirmed),
        )
        with held:
            if unconfirmed:
                # The watchdog stays armed, and must not act while the next requests take time.
                master.while_awaiting = log.alive
                announce(outcome)
            else:
                log.ended()
        with held:
            if session.addressed:
                session.note(
                    "not disabled" if unconfirmed else "disabled",
                    outcome.alarm or "every drive confirmed",
                )
        # The drives leave operational before the reports are read, because no heartbeat is sent
        # meanwhile.
        with held:
            session.leave(unconfirmed)
        with held:
            outcome = replace(outcome, reports=tuple(session.reports(unconfirmed)) if fault else ())
            session.note("mark", *outcome.reports)
        with held:
            if not unconfirmed:
                announce(outcome)
        if held.problem:
            with held:
                session.note("warning", f"an error while the drives were stopped: {held.problem}")
        held.raise_interrupt()
    return outcome


class _Session:
    """One run of a session.

    Phases are generators that yield the commands of each SYNC, and `_run` sends them.
    """

    def __init__(
        self, robot: Robot, master: bus.Master, log: SessionLog, task: Task, stop: Stop
    ) -> None:
        self._robot, self._log, self._task, self._stop = robot, log, task, stop
        self._master, self._link, self._bus = master, master.link, master.bus
        self._period_s = master.bus.file.sync_period_s
        self._pace, self._heartbeat = Pace(master), bus.MasterHeartbeat(master)
        self._motion: MotionState | None = None
        self._held: list[int] = []  # last target counts of the drives
        self._targets: list[Array] = []  # the last joint targets
        self._noted: set[str] = set()  # texts of warnings that were recorded
        self._in_fault: list[int] = []  # nodes found in fault before motion
        # The drives were started; anything was commanded or written to them.
        self._started = self.addressed = False
        self.cut_short = task.reference is not None  # until it has been followed
        self.held = HeldBack()  # exceptions while the drives are stopped

    def prepare(self) -> None:
        """Check, configure and start the drives.

        Raises
        ------
        RobotIdimError : a check fails.
        """
        track = self._task.reference is not None
        if self._task.reference is not None:
            check_limits(self._task.reference, self._robot, self._period_s, self._task.place)
            refuse_out_of_range(self._task.reference, self._robot, self._bus, self._task.place)
            check_carriers(self._bus)
        self.note("phase", "configure")
        if (refusal := bus.listen_for_others(self._master)) is not None:
            raise refusal
        # Drives are only read here, so one that another program has enabled stays as it is.
        self._in_fault = bus.refuse_enabled(self._master)
        self.note("mark", *(f"node {node}: in fault before the session" for node in self._in_fault))
        if track:
            self.note("mark", *self._task.before_motion(self._master))
            # Frames were received while the operator was asked, and must be taken before SYNC.
            self._master.wait(self._link.now_ns())
        needs = bus.read_needs(self._master, track=track)
        self.addressed = True
        self.note("warning", *bus.configure(self._master, needs, track=track))
        if track:
            self.note("mark", *(str(need) for need in needs if "unknown" in need.found))
            self.note("warning", *self._heartbeat.request())
        self._master.refuse_doubled()
        self._master.start()
        self._started = True
        self._pace.start()

    def note(self, kind: str, *texts: str) -> None:
        """Record texts as events."""
        for text in texts:
            self._log.event(self._link.now_ns(), kind, text)

    def _note_once(self, kind: str, text: str) -> None:
        if text not in self._noted:
            self._noted.add(text)
            self.note(kind, text)

    def phases(self) -> None:
        """Run one phase after the other."""
        if self._task.reference is None:
            self._run("record", self._record(), self._task.duration_s)
            return
        reference = self._task.reference
        self._run("enable", self._enable())
        if not all_enabled(self._master):
            # The operator stopped the session while drives were being enabled.
            self._run("disable", self._disable())
            return
        if not self._stop.reason:
            # The approach starts at the held targets. If it started at the measured positions, the
            # difference would be a step of the target.
            start = bus.joints_of(self._robot, self._bus, self._held)
            path = approach(start, reference[0], self._robot, self._period_s)
            check_limits(path, self._robot, self._period_s, "the approach to the reference's start")
            self._run("approach", self._follow(path), len(path) * self._period_s)
        if not self._stop.reason:
            self._run("track", self._follow(reference), len(reference) * self._period_s)
            self.cut_short = bool(self._stop.reason)
        self._run("stop", self._hold())
        self._run("disable", self._disable())

    def _run(
        self, name: str, orders: Iterator[bus.Orders | None], planned_s: float | None = None
    ) -> None:
        """Run a phase: at each SYNC, send its commands, take the answers and check the guards."""
        self._log.event(max(self._pace.next_ns, self._link.now_ns()), "phase", name)
        if planned_s is not None:
            self.note("plan", f"{name} {planned_s:g} s")
        for order in orders:
            if order is not None:
                self._held = [target for _, target in order]
                self._targets = [
                    *self._targets[-3:],
                    bus.joints_of(self._robot, self._bus, self._held),
                ]
                for watch, (control, target) in zip(self._master.nodes, order, strict=True):
                    bus.send_order(self._master, watch, control, target)
            self._sync()

    def _sync(self) -> None:
        """Send SYNC or wait for it, take the answers, and check the guards.

        Raises
        ------
        RobotIdimError : a guard detects a fault.
        """
        motion = self._motion
        in_motion = motion is not None and bool(motion.enabled)
        self._pace.sync(in_motion=in_motion)
        now_ns = self._link.now_ns()
        if self._master.signs or self._master.bus_error:
            # This raises an error if the watchdog sent those frames, as it is not another master.
            self._log.poll(now_ns)
        error = node_fault(self._master, now_ns) or self._other_master(in_motion)
        if error is None and motion is not None:
            if (q := self._positions()) is not None:
                motion.start = q if motion.start is None else motion.start
                motion.measured = [*motion.measured[-10:], q]
                # A drive takes one period to reach a target, so its position now belongs to the
                # target before the last.
                motion.target = self._targets[-2] if len(self._targets) >= 2 else None
                error = state_fault(self._master, motion) or joint_fault(
                    self._master, self._robot, motion
                )
            if error is None and self._stop.at_once:
                error = BusFaultError(f"{self._stop.reason}, and again: quick stop")
            for watch in self._master.nodes:
                for text in notices(watch.statusword or 0):
                    self._note_once("mark", f"node {watch.drive.node} ({watch.drive.name}): {text}")
        if error is not None:
            raise error
        self.note("operator", *self._task.notes())
        status = self._log.poll(now_ns)
        if status is not None and status.ends and not self._stop.reason:
            self._stop.reason, self.cut_short = status.ends, True

    def _other_master(self, in_motion: bool) -> RobotIdimError | None:
        """Return the fault of another master that commands the drives in motion; else None.

        Any other sign of a master is recorded as a warning, once.
        """
        signs, self._master.signs = self._master.signs, {}
        for sign, commands in signs.items():
            error = BusFaultError(
                f"another master is active ({sign})",
                place="bus",
                advice="Stop it before a motion",
            )
            if in_motion and commands:
                return error
            self._note_once("warning", str(error))
        return None

    def _positions(self) -> Array | None:
        """Return measured joint positions (n,); None until every drive has sent its position."""
        counts = [watch.counts for watch in self._master.nodes if watch.counts is not None]
        return (
            bus.joints_of(self._robot, self._bus, counts) if len(counts) == self._robot.n else None
        )

    def _record(self) -> Iterator[None]:
        since_ns, duration_s = self._link.now_ns(), self._task.duration_s
        while not self._stop.reason and (
            duration_s is None or self._link.now_ns() - since_ns < round(duration_s * 1e9)
        ):
            yield None

    def _enable(self) -> Iterator[bus.Orders | None]:
        """Enable all drives, each held at its position.

        The guards of motion are active from here on.
        """
        self._motion = MotionState()
        targets: list[int] = []
        for order in enable(self._master, targets, self._in_fault):
            if self._stop.reason:
                return
            yield order
        yield from itertools.takewhile(
            lambda _: not self._stop.reason,
            itertools.repeat(
                _enabled_at(self._held), round(self._bus.file.enable_watch_s / self._period_s)
            ),
        )
        self._motion.enabling = False

    def _follow(self, path: Array) -> Iterator[bus.Orders]:
        """Yield commands that keep drives enabled at the joint targets of `path` (N, n)."""
        for q in follow(path, self._robot, self._period_s, lambda: bool(self._stop.reason)):
            motor = self._robot.motor_position(q[None])[0]
            yield _enabled_at(
                [
                    int(drive.position_codec.raw(motor[i]))
                    for i, drive in enumerate(self._bus.drives)
                ]
            )

    def _hold(self) -> Iterator[bus.Orders]:
        yield from itertools.repeat(_enabled_at(self._held), max(3, round(HOLD_S / self._period_s)))

    def _disable(self) -> Iterator[bus.Orders]:
        """Disable all drives.

        The guards of motion are not active, because drives leave operation enabled here.
        """
        self._motion = None
        yield from disable(
            self._master, self._held or [watch.counts or 0 for watch in self._master.nodes]
        )

    def make_safe(self) -> list[int]:
        """Stop and disable every drive, or only read the states if none was commanded.

        Returns
        -------
        The node ids of the drives that did not confirm.
        """
        if not self.addressed or (not self._started and self._task.reference is None):
            self.addressed = False
            return []
        self._stop.reason = self._stop.reason or "safe state"
        if self._task.reference is None:
            return [drive.node for drive in self._bus.drives if not self._is_disabled(drive)]
        return bus.safe_stop(
            self._master, self.held, after_sync=lambda: self._log.poll(self._link.now_ns())
        )

    def _is_disabled(self, drive: Drive) -> bool:
        with self.held:
            return self._master.state(drive) in DISABLED
        return False

    def reports(self, unconfirmed: list[int]) -> list[str]:
        """Return error reports of drives in fault, one line each.

        Drives that did not confirm are left out.
        """
        in_fault = [
            watch.drive
            for watch in self._master.nodes
            if self.addressed and watch.drive.node not in unconfirmed
            if watch.emergency is not None
            or watch.state in (State.FAULT, State.FAULT_REACTION_ACTIVE)
        ]
        return [text for drive in in_fault if (text := bus.error_report(self._master, drive))]

    def leave(self, unconfirmed: list[int]) -> None:
        """End the heartbeat, and set the drives to PRE-OPERATIONAL."""
        if not self.addressed:
            return
        with self.held:
            nodes = [drive.node for drive in self._bus.drives if drive.node not in unconfirmed]
            self.note("warning", *self._heartbeat.release(nodes))
        bus.leave_operational(self._master)


def _enabled_at(counts: list[int]) -> bus.Orders:
    """Return commands that keep drives enabled at the target counts."""
    return [(Command.ENABLE_OPERATION.controlword, target) for target in counts]
