"""The stop of all drives: quick stop, voltage off at standstill, then reading back every state.

The session, the watchdog (after the session has died or hangs) and the command `disable` use it.
No exception ends the stop: if one step fails, the next is tried.
"""

import itertools
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field

from ..errors import HeldBack, RobotIdimError
from ..protocol import (
    RAMP_OBJECTS,
    Command,
    State,
    answer_of,
    quick_stop_ramp,
    read_request,
    state_of,
    write_request,
)
from ..robot import Bus, axis_index
from .links import open_link
from .master import PRE_OPERATIONAL, SDO_TIMEOUT_NS, STOPPED, Master, NodeWatch, send_order

# Within this time of a quick stop, the speed must begin to fall.
FALL_S = 0.05
# The speed falls if its slope is below this share of the acceleration limit.
FALL_SLOPE = -0.2
# If the deceleration is unknown, the speed must fall below this share of the speed at the start.
FALL_SHARE = 0.95
# A drive may take this multiple of the time that its deceleration needs from the first speed.
RAMP_SHARE = 1.2
# After the time to stop and this margin, voltage is switched off even in motion.
CAP_S = 0.5
# Drives must confirm within this time after voltage is switched off.
CONFIRM_S = 1.0
ASK_S = 0.05  # between SDO requests to one drive
# Speeds are measured over this time, in which encoder noise is small against motion.
WINDOW_S = 0.02
# A drive is at standstill below this share of its speed limit, or below so many counts in the
# window, because encoder noise does not count as motion.
STANDSTILL_SHARE = 0.01
STANDSTILL_COUNTS = 2
# In these states a drive gives no torque, and needs the whole enabling sequence again. Switched on
# does not count as disabled.
CONFIRMED = frozenset({State.SWITCH_ON_DISABLED, State.FAULT})


@dataclass(kw_only=True)
class _Stopping:
    """One drive while it is stopped. Times are those of the link.

    Attributes:
        watch: last values of the drive.
        since_ns: time at which the stop began.
        period_ns: SYNC period.
        window: number of SYNCs in WINDOW_S.
        seen: times and counts of the last FALL_S.
        speed_then: speed at the start, counts/s.
        off_ns: time at which voltage was switched off.
        confirmed: True once the drive has confirmed that it is disabled.
        wrote: last command sent by SDO.
        request: SDO request that is not answered yet; else empty.
        asked_ns: time of the last SDO request.
        reading: object of `RAMP_OBJECTS` that the last request reads; else 0.
    """

    watch: NodeWatch
    since_ns: int
    period_ns: int
    window: int
    seen: list[tuple[int, int]] = field(default_factory=list)
    speed_then: float | None = None
    off_ns: int | None = None
    confirmed: bool = False
    wrote: Command | None = None
    request: bytes = b""
    asked_ns: int = -(10**18)
    reading: int = 0

    def observe(self, sampled_ns: int) -> None:
        """Take the position that the drive sent for the SYNC at `sampled_ns`, if it sent one."""
        counts = self.watch.counts
        if (
            self.watch.answers
            and counts is not None
            and (not self.seen or sampled_ns > self.seen[-1][0])
        ):
            self.seen = [
                *self.seen[-max(2, round(FALL_S / WINDOW_S * self.window)) :],
                (sampled_ns, counts),
            ]
            if self.speed_then is None and sampled_ns - self.seen[0][0] >= 0.5e9 * WINDOW_S:
                self.speed_then = _speed(self.seen)

    def must_go_off(self, now_ns: int) -> bool:
        """Test whether to switch voltage off.

        The reasons are standstill, a speed that does not fall, and the end of the time to stop.
        """
        elapsed_s, then, drive = (now_ns - self.since_ns) * 1e-9, self.speed_then, self.watch.drive
        # If a drive sends no positions any more, only the time decides when it is switched off.
        if then is None or now_ns - self.seen[-1][0] > (self.window + 1) * self.period_ns:
            return elapsed_s >= self.longest_s
        first, last = self.seen[: self.window + 1], self.seen[-self.window - 1 :]
        speed, noise = _speed(last), STANDSTILL_COUNTS * 1e9 / (last[-1][0] - last[0][0])
        if speed <= max(STANDSTILL_SHARE * (drive.motion.speed or 0.0), noise):
            return True
        between_s = (last[0][0] + last[-1][0] - first[0][0] - first[-1][0]) / 2e9
        if elapsed_s >= FALL_S and between_s:
            slope = (speed - _speed(first)) / between_s
            unknown = self.ramp is None and len(self.watch.ramp_objects) == len(RAMP_OBJECTS)
            rises = (
                slope >= FALL_SLOPE * (drive.motion.acceleration or 0.0) and speed >= then - noise
            )
            if rises or (unknown and speed >= FALL_SHARE * then):
                return True
        return elapsed_s >= self.longest_s

    @property
    def ramp(self) -> float | None:
        """Quick stop deceleration, counts/s²; None if it is unknown."""
        return quick_stop_ramp(self.watch.ramp_objects, self.watch.drive.position_codec)

    @property
    def longest_s(self) -> float:
        """Longest time until voltage is switched off, s.

        It is the time to stop from the speed at the start by the deceleration, with a margin, plus
        CAP_S. An unknown speed is replaced by the speed limit.
        """
        drive = self.watch.drive
        speed = self.speed_then if self.speed_then is not None else drive.motion.speed or 0.0
        slowing = self.ramp / RAMP_SHARE if self.ramp else drive.motion.acceleration
        return CAP_S + (speed / slowing if slowing else 0.0)


def _speed(seen: list[tuple[int, int]]) -> float:
    return abs(seen[-1][1] - seen[0][1]) * 1e9 / (seen[-1][0] - seen[0][0])


def safe_stop(
    master: Master, held: HeldBack, *, after_sync: Callable[[], object] = lambda: None
) -> list[int]:
    """Stop and disable every drive.

    All drives get the quick stop at once, by PDO (if configured) and by SDO, while SYNC continues.
    The voltage of each drive is switched off at its measured standstill, or if its speed rises or
    holds for 50 ms. At the latest this happens 0.5 s after 1.2 times the time that its deceleration
    takes. The deceleration is read meanwhile; if it is unknown, the limit is v/a + 0.5 s.

    Then the statusword (6041h) of each drive is read for up to a second, until it shows switch on
    disabled or fault (CiA 402). A node in NMT state stopped accepts neither PDO nor SDO, so it is
    set to PRE-OPERATIONAL first (CiA 301).

    Parameters
    ----------
    master : has the drives and an open link.
    held : holds back all exceptions, also those of `after_sync`.
    after_sync : called after every SYNC.

    Returns
    -------
    The node ids of the drives that did not confirm.
    """
    now_ns, period_ns = master.link.now_ns(), master.bus.period_ns
    window = max(1, round(WINDOW_S * 1e9 / period_ns))
    drives = [
        _Stopping(watch=w, since_ns=now_ns, period_ns=period_ns, window=window)
        for w in master.nodes
    ]
    # The period of the SYNCs before continues, because drives interpolate between them.
    next_ns = max(now_ns, (master.synced_ns or 0) + period_ns)
    # The number of SYNCs limits the loop too, because the time may not advance on a link that
    # cannot be read.
    for count in itertools.count():
        if count * period_ns > 2e9 * (max(one.longest_s for one in drives) + CONFIRM_S):
            break
        with held:
            for one in drives:
                _command(master, one)
        next_ns = _sync(master, next_ns, held)
        with held:
            after_sync()
        with held:
            now_ns = master.link.now_ns()
            for one in drives:
                # Drives sample their position at SYNC.
                one.observe(master.synced_ns or now_ns)
                _collect(master, one)
                if one.off_ns is None and (one.confirmed or one.must_go_off(now_ns)):
                    one.off_ns = now_ns
        if all(one.confirmed for one in drives) or all(
            one.off_ns is not None and now_ns - one.off_ns > CONFIRM_S * 1e9 for one in drives
        ):
            break
    unconfirmed = [one for one in drives if not one.confirmed]
    for one in unconfirmed:
        with held:
            one.off_ns = one.off_ns or now_ns
            _command(master, one)
    return [one.watch.drive.node for one in unconfirmed]


def stop_drives(bus: Bus) -> list[int]:
    """Open the bus, stop and disable all drives, and set them to PRE-OPERATIONAL.

    An interrupt (Ctrl-C) is raised afterwards, but only if all drives have confirmed.

    Parameters
    ----------
    bus : the bus and its drives.

    Returns
    -------
    The node ids of the drives that did not confirm.

    Raises
    ------
    BusFaultError : the bus cannot be opened.
    """
    held, link = HeldBack(), open_link(bus.file, passive=False)
    master = Master(link, bus)
    unconfirmed = safe_stop(master, held)
    with held:
        leave_operational(master)
    with held:
        link.close()
    if not unconfirmed:
        held.raise_interrupt()
    return unconfirmed


def not_disabled(nodes: Iterable[int]) -> str:
    """Return the message that is shown first if drives did not confirm."""
    return f"NOT DISABLED: nodes {', '.join(map(str, nodes))}: EMERGENCY STOP"


def leave_operational(master: Master) -> None:
    """Set every drive to PRE-OPERATIONAL, in which it accepts no command by PDO."""
    for watch in master.nodes:
        with suppress(RobotIdimError):
            master.nmt(PRE_OPERATIONAL, watch.drive.node)


def _command(master: Master, one: _Stopping) -> None:
    """Send quick stop, or disable voltage once it is off, by PDO and by SDO.

    The target of the PDO is the last measured position. Without one, no PDO is sent.
    """
    command = Command.QUICK_STOP if one.off_ns is None else Command.DISABLE_VOLTAGE
    if one.watch.nmt == STOPPED:
        with suppress(RobotIdimError):
            master.nmt(PRE_OPERATIONAL, one.watch.drive.node)
            one.watch.nmt = None  # until its next heartbeat
            # No request before this command has reached the drive, so all are sent again.
            one.wrote, one.request = None, b""
    # A bus that refuses frames now may accept them later.
    with suppress(RobotIdimError):
        if one.watch.counts is not None:
            send_order(master, one.watch, command.controlword, one.watch.counts)
    with suppress(RobotIdimError):
        _ask(master, one, command)


def _ask(master: Master, one: _Stopping, command: Command) -> None:
    """Send a new command by SDO at once, then read the statusword.

    The next request is sent when the last one was answered or has timed out.
    """
    drive, now_ns = one.watch.drive, master.link.now_ns()
    pause_ns = SDO_TIMEOUT_NS if one.request else ASK_S * 1e9
    if one.wrote is command and now_ns - one.asked_ns < pause_ns:
        return
    # A drive that has not answered until now does not have the object.
    if one.reading:
        one.watch.ramp_objects[one.reading] = None
    one.reading = 0
    if one.wrote is command:
        # The deceleration matters only in motion.
        if one.off_ns is None:
            one.reading = next(
                (index for index in RAMP_OBJECTS if index not in one.watch.ramp_objects), 0
            )
        one.request = read_request(
            *((axis_index(drive, one.reading), 0) if one.reading else drive.status.key)
        )
    else:
        word, size = command.controlword, drive.control.bits // 8
        one.request = write_request(drive.control.index, drive.control.sub, word, size)
    one.wrote, one.asked_ns = command, now_ns
    master.post(drive.node, one.request)


def _collect(master: Master, one: _Stopping) -> None:
    """Take the answer to the last request.

    If the drive is not in the commanded state, the command is sent again.
    """
    data = master.answered(one.watch.drive.node, one.request) if one.request else None
    if data is None:
        return
    one.request, answer = b"", answer_of(data)
    if one.reading:
        one.watch.ramp_objects[one.reading] = answer.number if answer.kind == "value" else None
    if one.reading or answer.kind != "value":
        one.reading = 0
        # The write was accepted or refused, so the state is read at once.
        one.asked_ns = -(10**18)
        return
    with suppress(RobotIdimError):
        state = state_of(answer.number)
        one.confirmed = state in CONFIRMED
        if not one.confirmed and (one.off_ns is not None or state is State.OPERATION_ENABLED):
            one.wrote = None


def _sync(master: Master, next_ns: int, held: HeldBack) -> int:
    """Send SYNC, take the answers, and return when the next SYNC is due, in ns.

    If another producer sends SYNC, the function waits for that SYNC instead.
    """
    link, period_ns = master.link, master.bus.period_ns
    with held:
        if master.bus.file.sync_producer == "recorder":
            master.wait(next_ns)
            if link.now_ns() > next_ns + period_ns:
                # After a delay the period starts anew, so that no burst of SYNCs is sent.
                next_ns = link.now_ns()
            master.sync()
        else:
            for watch in master.nodes:
                # If no SYNC is received, the last position is not a new measurement.
                watch.answers = 0
            master.wait_for_sync(link.now_ns() + 2 * period_ns)
            next_ns = link.now_ns()
        master.wait(link.now_ns() + round(0.7 * period_ns), for_answers=True)
        return next_ns + period_ns
    # An exception was held back. The next round takes the answers of this one.
    return link.now_ns() + period_ns
