"""Stops all drives: quick stop, voltage off at standstill, then the state of
every drive is read back.

The session, the recorder's process (after the session has died) and the command `disable` use it.
Nothing that is raised ends it: if one step fails, the next is tried.
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

FALL_S = 0.05  # over which the speed must fall in a quick stop
FALL_SLOPE = -0.2  # of the acceleration limit: below this slope the speed counts as falling
# of the speed at the start: with an unknown ramp, the speed has fallen when below this
FALL_SHARE = 0.95
RAMP_SHARE = 1.2  # of the time that the ramp takes from the speed at the start
CAP_S = 0.5  # after the time to stop, voltage is switched off even in motion
CONFIRM_S = 1.0  # in which drives must confirm, after voltage is off
ASK_S = 0.05  # between SDO requests to one drive
WINDOW_S = 0.02  # over which speed is measured
STANDSTILL_SHARE = 0.01  # of the speed limit
STANDSTILL_COUNTS = 2  # in the window: encoder noise does not count as motion
# In these states a drive gives no torque and needs a whole new enabling sequence. Switched on does
# not count as disabled.
CONFIRMED = frozenset({State.SWITCH_ON_DISABLED, State.FAULT})


@dataclass(kw_only=True)
class _Stopping:
    """One drive while it is stopped; times are those of the link."""

    watch: NodeWatch
    since_ns: int
    period_ns: int
    window: int  # number of SYNCs in WINDOW_S
    seen: list[tuple[int, int]] = field(default_factory=list)  # time and counts, of the last FALL_S
    speed_then: float | None = None  # counts/s at the start
    off_ns: int | None = None
    confirmed: bool = False
    wrote: Command | None = None  # the last command sent by SDO
    request: bytes = b""
    asked_ns: int = -(10**18)
    reading: int = 0  # of RAMP_OBJECTS, by the last request

    def observe(self, sampled_ns: int) -> None:
        """Take the position that the drive sent at the SYNC of `sampled_ns`, if it sent one."""
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
        """Test whether to switch voltage off: standstill, the speed does not fall, or the time to
        stop is over.
        """
        elapsed_s, then, drive = (now_ns - self.since_ns) * 1e-9, self.speed_then, self.watch.drive
        # A drive that sends no positions any more is switched off by time alone.
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
        """Quick stop deceleration, counts/s², None if unknown."""
        return quick_stop_ramp(self.watch.ramp_objects, self.watch.drive.position_codec)

    @property
    def longest_s(self) -> float:
        """Time to stop from the speed at the start (unknown: the speed limit) by the deceleration,
        with a margin, and CAP_S.
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
    """Stop and disable every drive of `master`; return the node ids of those that did not confirm.

    All drives get the quick stop at once, by PDO (where configured) and by SDO, while SYNC
    continues. Voltage is switched off for each drive at its measured standstill, where its speed
    rises or holds for 50 ms, and at the latest 0.5 s after 1.2 times the time that its deceleration
    takes (it is read on the way; unknown: after v/a + 0.5 s). Then each drive's statusword (6041h)
    is read for up to a second, until it shows switch on disabled or fault (CiA 402). A node that is
    in NMT stopped takes neither PDO nor SDO: it is set to PRE-OPERATIONAL first (CiA 301, NMT).
    `after_sync` is called after every SYNC. Whatever is raised, by `after_sync` too, is left to
    `held`.
    """
    now_ns, period_ns = master.link.now_ns(), master.bus.period_ns
    window = max(1, round(WINDOW_S * 1e9 / period_ns))
    drives = [
        _Stopping(watch=w, since_ns=now_ns, period_ns=period_ns, window=window)
        for w in master.nodes
    ]
    # the period of earlier SYNCs continues
    next_ns = max(now_ns, (master.synced_ns or 0) + period_ns)
    # The loop is also limited by the number of SYNCs: on a link that cannot be read,
    # time may stand still.
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
                one.observe(master.synced_ns or now_ns)  # drives sample at SYNC
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
    """Open the bus, `safe_stop`, then PRE-OPERATIONAL; return the node ids of the drives that did
    not confirm.

    An interrupt (Ctrl-C) is raised afterwards, unless the result is not what it has to be.
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
    """Set every drive to PRE-OPERATIONAL, one by one: from then on it takes no command by PDO."""
    for watch in master.nodes:
        with suppress(RobotIdimError):
            master.nmt(PRE_OPERATIONAL, watch.drive.node)


def _command(master: Master, one: _Stopping) -> None:
    """Send quick stop, or disable voltage once it is off, by PDO with the last measured position
    as target (without one: not at all), and by SDO.
    """
    command = Command.QUICK_STOP if one.off_ns is None else Command.DISABLE_VOLTAGE
    if one.watch.nmt == STOPPED:
        with suppress(RobotIdimError):
            master.nmt(PRE_OPERATIONAL, one.watch.drive.node)
            one.watch.nmt = None  # until its next heartbeat
            one.wrote, one.request = None, b""  # no request before this one reached it
    with suppress(RobotIdimError):  # a bus that refuses frames now may accept them later
        if one.watch.counts is not None:
            send_order(master, one.watch, command.controlword, one.watch.counts)
    with suppress(RobotIdimError):
        _ask(master, one, command)


def _ask(master: Master, one: _Stopping, command: Command) -> None:
    """Send a new command by SDO at once; then read the statusword each time the last request was
    answered or has timed out.
    """
    drive, now_ns = one.watch.drive, master.link.now_ns()
    pause_ns = SDO_TIMEOUT_NS if one.request else ASK_S * 1e9
    if one.wrote is command and now_ns - one.asked_ns < pause_ns:
        return
    if one.reading:  # not answered
        one.watch.ramp_objects[one.reading] = None
    one.reading = 0
    if one.wrote is command:
        if one.off_ns is None:  # the ramp matters in motion only
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
    """Take the answer to the last request; where the drive is in another state than commanded, the
    command is sent again.
    """
    data = master.answered(one.watch.drive.node, one.request) if one.request else None
    if data is None:
        return
    one.request, answer = b"", answer_of(data)
    if one.reading:
        one.watch.ramp_objects[one.reading] = answer.number if answer.kind == "value" else None
    if one.reading or answer.kind != "value":
        one.reading = 0
        one.asked_ns = -(10**18)  # the write was accepted or refused: read the state at once
        return
    with suppress(RobotIdimError):
        state = state_of(answer.number)
        one.confirmed = state in CONFIRMED
        if not one.confirmed and (one.off_ns is not None or state is State.OPERATION_ENABLED):
            one.wrote = None


def _sync(master: Master, next_ns: int, held: HeldBack) -> int:
    """Send SYNC, or await that of the other producer, and take the answers; return when the next
    one is due.
    """
    link, period_ns = master.link, master.bus.period_ns
    with held:
        if master.bus.file.sync_producer == "recorder":
            master.wait(next_ns)
            if link.now_ns() > next_ns + period_ns:
                next_ns = link.now_ns()  # after a delay, no burst of SYNCs
            master.sync()
        else:
            for watch in master.nodes:
                watch.answers = 0  # where no SYNC comes, the last position is no measurement
            master.wait_for_sync(link.now_ns() + 2 * period_ns)
            next_ns = link.now_ns()
        master.wait(link.now_ns() + round(0.7 * period_ns), for_answers=True)
        return next_ns + period_ns
    return link.now_ns() + period_ns  # the next round takes the answers of this one
