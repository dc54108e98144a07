"""The only loop: listen, or configure and record, or enable, approach, track, stop. Safe state in `finally`.

Nothing moves unless a plan has a reference. Whatever ends a session that touched the drives, its last act is to disable
every one of them and to write down which ones confirmed it.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from . import AcquisitionError
from .cia402 import DISABLED, MODE_OF_OPERATION, Command, Mode, State, toward
from .drives import Drive, refuse_out_of_range
from .guards import Motion, motion_fault, node_fault
from .listening import refuse_enabled, refuse_other_master
from .master import Master, axis_of
from .master_heartbeat import MasterHeartbeat
from .recorder import Status
from .reference import approach, check_limits
from .robot import Robot
from .safe_stop import leave_operational, safe_stop

Vector = NDArray[np.float64]
Orders = list[tuple[int, int]]  # controlword and target counts of each drive

ENABLE_S = 5.0  # for all drives to be enabled, or disabled
HOLD_S = 0.3  # at the end of motion, before drives are disabled
SLOW_STOP_S = 0.5  # in which a stop asked for comes to rest along the path
# Down in order, so that a drive may brake and hold before it lets go.
_DOWN = {
    State.OPERATION_ENABLED: Command.SWITCH_ON,
    State.SWITCHED_ON: Command.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Command.DISABLE_VOLTAGE,
    State.QUICK_STOP_ACTIVE: Command.DISABLE_VOLTAGE,
}


class Log(Protocol):
    """Where a session writes down what happens; the frames come to it by themselves."""

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Note what happened."""
        ...

    def poll(self, stamp_ns: int) -> Status | None:
        """Latest news of the recorder, None when there are none. Raises `AcquisitionError` when it has ended."""
        ...


@dataclass(kw_only=True)
class Stop:
    """Set from outside (Ctrl-C, SIGTERM) to end a session in order."""

    reason: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """What a session does: for how long, and along which joint positions (N, n), one row each SYNC."""

    duration_s: float | None = None
    reference: Vector | None = None
    place: str = "reference"


@dataclass(frozen=True, kw_only=True)
class Ending:
    """How a session ended: in order or by a fault, and whether every drive that was addressed confirmed to be disabled."""

    reason: str
    fault: bool
    all_disabled: bool


@dataclass(kw_only=True)
class _Beat:
    """The rhythm of SYNC."""

    next_ns: int
    until_ns: int | None
    motion: Motion | None = None
    targets: list[Vector] = field(default_factory=list)


def run_active(robot: Robot, master: Master, log: Log, plan: Plan, stop: Stop) -> Ending:
    """Configure the drives, produce SYNC, record; follow the plan's reference where it has one.

    Raises what was raised inside, after the drives were disabled.
    """
    link = master.link
    session = _Session(robot, master, log, plan, stop)
    reason, fault = "", True
    try:
        session.prepare()
        session.phases()
        reason, fault = stop.reason or "finished", False
    except AcquisitionError as error:
        reason = str(error)
    except BaseException as error:
        reason = f"{type(error).__name__}: {error}"
        raise
    finally:
        with suppress(AcquisitionError):  # a recorder that has ended keeps no drive enabled
            log.event(link.now_ns(), "fault" if fault else "end", reason)
        unconfirmed = session.make_safe()
        if session.addressed:
            text = f"nodes {unconfirmed} did not confirm" if unconfirmed else "every drive confirmed"
            with suppress(AcquisitionError):
                log.event(link.now_ns(), "not disabled" if unconfirmed else "disabled", text)
    return Ending(reason=reason, fault=fault, all_disabled=not unconfirmed)


class _Session:
    """One run: every method below either yields orders for one SYNC after the other, or carries them out."""

    def __init__(self, robot: Robot, master: Master, log: Log, plan: Plan, stop: Stop) -> None:
        self._robot, self._master, self._log, self._plan, self._stop = robot, master, log, plan, stop
        self._link, self._bus = master.link, master.bus
        self._period_s = master.bus.file.sync_period_s
        self._beat = _Beat(next_ns=0, until_ns=None)
        self._heartbeat = MasterHeartbeat(master)
        self.addressed = False  # whether anything was commanded or written to the drives

    def prepare(self) -> None:
        """Everything that can be refused before a node is started."""
        if self._plan.reference is not None:
            check_limits(self._plan.reference, self._robot, self._period_s, self._plan.place)
            refuse_out_of_range(self._plan.reference, self._robot, self._bus, self._plan.place)
            self._check_carriers()
        self._log.event(self._link.now_ns(), "phase", "configure")
        refuse_other_master(self._master)
        self._refuse_enabled()  # by reading alone: who else holds a drive keeps it as it is
        self.addressed = True
        self._master.configure()
        differences = self._master.differences()
        if differences:
            raise AcquisitionError("; ".join(differences))
        if self._plan.reference is not None:
            self._master.choose_mode(Mode.CYCLIC_SYNCHRONOUS_POSITION)
            for text in self._heartbeat.request():
                self._log.event(self._link.now_ns(), "warning", text)
        self._master.start()
        now_ns = self._link.now_ns()
        self._beat.next_ns = now_ns + self._bus.period_ns
        if self._plan.duration_s is not None:
            self._beat.until_ns = now_ns + round(self._plan.duration_s * 1e9)

    def _refuse_enabled(self) -> None:
        """A drive that gives torque before it was told to is somebody else's; one in fault is told, and reset later."""
        reset = "; it is reset" if self._plan.reference is not None else ""
        for node in refuse_enabled(self._master):
            self._log.event(self._link.now_ns(), "mark", f"node {node}: found in fault{reset}")

    def _check_carriers(self) -> None:
        """PDOs to the drives carry what tracking commands, and nothing else: what we do not know would be set to 0."""
        for drive in self._bus.drives:
            mode = f"{MODE_OF_OPERATION + axis_of(drive):04X}:0"
            known = {str(entry) for entry in (drive.control, drive.target)} | {mode}
            for entry in (drive.control, drive.target):
                if drive.carrier(entry, "rpdo") is None:
                    raise AcquisitionError(
                        f"node {drive.node}: no PDO to the drive carries {entry}: expected one to track"
                    )
            if drive.carrier(drive.status, "tpdo") is None:
                raise AcquisitionError(
                    f"node {drive.node}: no PDO from it carries {drive.status}: expected one to track"
                )
            for other in (str(e) for pdo in drive.rpdos for e in pdo.entries if str(e) not in known):
                told = f"node {drive.node}: a PDO to the drive carries {other}"
                raise AcquisitionError(f"{told}: expected only {', '.join(sorted(known))} to track")

    def phases(self) -> None:
        """One phase after the other, each until it ends."""
        if self._plan.reference is None:
            self._run("record", self._record())
            return
        reference = self._plan.reference
        self._run("enable", self._enable())
        if not all(watch.state is State.OPERATION_ENABLED for watch in self._master.nodes):
            self._run("disable", self._disable())  # a stop was asked for in between
            return
        self._beat.motion = Motion(measured=[])
        if not self._stop.reason:
            way = approach(self._positions(), reference[0], self._robot, self._period_s)
            check_limits(way, self._robot, self._period_s, "the approach to the reference's start")
            self._run("approach", self._follow(way))
        if not self._stop.reason:
            self._run("track", self._follow(reference))
        self._run("stop", self._hold())
        self._beat.motion = None
        self._run("disable", self._disable())

    def _run(self, name: str, orders: Iterator[Orders | None]) -> None:
        """Carry out a phase: at each SYNC answers, guards, then the next orders, in force from the SYNC after."""
        self._log.event(max(self._beat.next_ns, self._link.now_ns()), "phase", name)
        for order in orders:
            if order is not None:
                self._send(order)
            self._sync()

    def _sync(self) -> None:
        """SYNC at its time, the answers to it, and the guards."""
        beat, period_ns = self._beat, self._bus.period_ns
        if self._bus.file.sync_producer == "recorder":
            self._master.wait(beat.next_ns)
            if self._link.now_ns() > beat.next_ns + period_ns:
                beat.next_ns = self._link.now_ns()  # after a stall time goes on from here: no burst of SYNCs
            self._master.sync()
        elif not self._master.wait_for_sync(beat.next_ns + 50 * period_ns):
            raise AcquisitionError(
                "bus: no SYNC in 50 periods: expected the other producer's; or sync_producer = 'recorder'"
            )
        else:
            beat.next_ns = self._link.now_ns()
        self._master.wait(beat.next_ns + round(0.7 * period_ns), for_answers=True)
        beat.next_ns += period_ns
        now_ns = self._link.now_ns()
        reason = node_fault(self._master, now_ns)
        if reason is None and beat.motion is not None:
            beat.motion.measured = [*beat.motion.measured[-10:], self._positions()]
            # The target of the SYNC before the last is where a drive stands now: it takes a period to get there.
            beat.motion.target = beat.targets[-2] if len(beat.targets) >= 2 else None
            reason = motion_fault(self._master, self._robot, beat.motion)
        if reason is not None:
            raise AcquisitionError(reason)
        status = self._log.poll(now_ns)
        if status is not None and status.disk_full and not self._stop.reason:
            self._stop.reason = "disk nearly full"

    def _positions(self) -> Vector:
        """Measured joint positions (n,)."""
        motors = []
        for watch in self._master.nodes:
            if watch.counts is None:
                raise AcquisitionError(f"node {watch.drive.node}: no position yet: expected an answer to SYNC")
            motors.append(watch.drive.position_codec.si(np.array(watch.counts)))
        q: Vector = self._robot.joint_position(np.array(motors)[None])[0]
        return q

    def _send(self, orders: Orders) -> None:
        for watch, (control, target) in zip(self._master.nodes, orders, strict=True):
            drive = watch.drive
            values = {
                (drive.control.index, drive.control.sub): control,
                (drive.target.index, drive.target.sub): target,
                (MODE_OF_OPERATION + axis_of(drive), 0): int(Mode.CYCLIC_SYNCHRONOUS_POSITION),
            }
            for pdo in drive.rpdos:
                self._link.send(pdo.can_id, pdo.pack(values))

    def _orders(self, controls: list[int], q: Vector | None = None) -> Orders:
        """Controlwords with joint targets, or with the positions at hand."""
        if q is None:
            self._beat.targets.clear()
            return [(c, watch.counts or 0) for c, watch in zip(controls, self._master.nodes, strict=True)]
        self._beat.targets = [*self._beat.targets[-3:], q]
        motor = self._robot.motor_position(q[None])[0]
        counts = [int(watch.drive.position_codec.raw(motor[i])) for i, watch in enumerate(self._master.nodes)]
        return list(zip(controls, counts, strict=True))

    def _record(self) -> Iterator[None]:
        while not self._stop.reason and (self._beat.until_ns is None or self._link.now_ns() < self._beat.until_ns):
            yield None

    def _enable(self) -> Iterator[Orders | None]:
        """All drives to operation enabled, each targeted at where it stands."""
        cycles = round(ENABLE_S / self._period_s)
        for k in range(cycles):
            states = [watch.state for watch in self._master.nodes]
            if self._stop.reason or all(state is State.OPERATION_ENABLED for state in states):
                return
            if any(watch.counts is None or watch.state is None for watch in self._master.nodes):
                yield None
                continue
            controls = []
            for state in states:
                command = toward(state, State.OPERATION_ENABLED) if state is not None else None
                if state is State.OPERATION_ENABLED:
                    command = Command.ENABLE_OPERATION
                if command is Command.FAULT_RESET and k % 2:
                    command = None  # it acts on the rising edge
                controls.append(command.controlword if command else 0)
            yield self._orders(controls)
        told = ", ".join(
            f"node {w.drive.node} {w.state.words if w.state else 'silent'}"
            for w in self._master.nodes
            if w.state is not State.OPERATION_ENABLED
        )
        raise AcquisitionError(f"not enabled after {ENABLE_S:g} s: {told}: expected operation enabled")

    def _follow(self, path: Vector) -> Iterator[Orders]:
        """Along a path, one row a SYNC; when a stop is asked for, ever slower until at rest.

        Slowing down takes at most half of each joint's acceleration limit, beside what the path itself takes.
        """
        at, rate = 0.0, 1.0
        speed = np.abs(np.diff(path, axis=0)).max(axis=0, initial=0.0) / self._period_s
        stop_s = max(
            SLOW_STOP_S, *(2 * v / j.si("acceleration") for v, j in zip(speed, self._robot.joints, strict=True))
        )
        enabled = [Command.ENABLE_OPERATION.controlword] * self._robot.n
        while at < len(path) - 1 and rate > 0.0:
            yield self._orders(enabled, _between(path, at))
            if self._stop.reason:
                rate = max(0.0, rate - self._period_s / stop_s)
            at = min(at + rate, len(path) - 1.0)
        yield self._orders(enabled, _between(path, at))

    def _hold(self) -> Iterator[Orders]:
        where = self._beat.targets[-1] if self._beat.targets else self._positions()
        for _ in range(max(3, round(HOLD_S / self._period_s))):
            yield self._orders([Command.ENABLE_OPERATION.controlword] * self._robot.n, where)

    def _disable(self) -> Iterator[Orders]:
        """Down in order, all drives together."""
        for _ in range(round(ENABLE_S / self._period_s)):
            states = [watch.state for watch in self._master.nodes]
            if all(state in (State.SWITCH_ON_DISABLED, State.FAULT) for state in states):
                return
            downs = [
                Command.DISABLE_VOLTAGE if state is None else _DOWN.get(state, Command.DISABLE_VOLTAGE)
                for state in states
            ]
            yield self._orders([command.controlword for command in downs])
        raise AcquisitionError(f"not disabled after {ENABLE_S:g} s: expected switch on disabled")

    def make_safe(self) -> list[int]:
        """Stop and disable every drive, whatever happened; nodes that did not confirm.

        Without a reference nothing was commanded: drives that were started are asked for their state.
        """
        if not self.addressed or (self._beat.next_ns == 0 and self._plan.reference is None):
            self.addressed = False
            return []
        self._stop.reason = self._stop.reason or "safe state"
        if self._plan.reference is not None:
            unconfirmed = safe_stop(self._master, after_sync=lambda: self._log.poll(self._link.now_ns()))
        else:
            unconfirmed = [drive.node for drive in self._bus.drives if not self._is_disabled(drive)]
        with suppress(AcquisitionError):
            for text in self._heartbeat.release([d.node for d in self._bus.drives if d.node not in unconfirmed]):
                self._log.event(self._link.now_ns(), "warning", text)
        leave_operational(self._master)
        return unconfirmed

    def _is_disabled(self, drive: Drive) -> bool:
        try:
            return self._master.state(drive) in DISABLED
        except AcquisitionError:
            return False


def _between(path: Vector, at: float) -> Vector:
    """Row of a path at a place between rows."""
    k = min(int(at), len(path) - 2) if len(path) > 1 else 0
    then = path[min(k + 1, len(path) - 1)]
    q: Vector = path[k] + (at - k) * (then - path[k])
    return q
