"""The sessions of `record`, with link, recorder and status; and the replay of `emulate`."""

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType

import numpy as np

from ..bus import (
    LISTEN_S,
    SHARED,
    Confirm,
    Link,
    Master,
    WallClock,
    confirm_motion,
    listening_words,
    open_link,
    refuse_unsupervised,
    second_stop,
    service_of,
)
from ..errors import COMMAND_LINE, Location, RefusedError, RobotIdimError
from ..options import RecordOptions
from ..protocol import ANSWER, EMERGENCY, HEARTBEAT
from ..recording import (
    ERROR,
    EXTENDED,
    REMOTE_REQUEST,
    Block,
    Recording,
    read_recording,
    resolve_mapped,
)
from ..robot import (
    FILL_IN,
    HOW_TO_CONFIRM,
    Bus,
    BusFile,
    Payload,
    Robot,
    check_limits,
    lines_to_fill_in,
    parse_payload,
    refuse_load,
    resolve,
    table_reference,
)
from ..simulated import LockStepLink, SimulatedDrives, describe_loops, driven_plant
from .logs import InlineLog, OnStatus, ProcessLog
from .process import STOPPING, Role
from .recorder import RecordedSummary, Recorder, Status, refuse_taken
from .session import Outcome, Stop, Task, run_active
from .timing import real_time_scheduling, refuse_jitter, scheduling_words

STOPPED = "stopped by"
# The operator has pressed Ctrl-C, which is not an error.
INTERRUPTED = f"{STOPPED} {signal.SIGINT.name}"


@dataclass(frozen=True, kw_only=True)
class UserInterface:
    """The callbacks by which a session is stopped, shows its state and asks its operator.

    By default nothing moves.

    Attributes:
        stop: ends the session when its `reason` is set.
        confirm: shows joint positions and drives in fault before motion, and returns True if the
            operator confirms them.
        show: called twice a second with the status of the recorder and the seconds left.
        announce: called as soon as the outcome is known.
        note: called with the effect of a passive recording on the bus, before the bus is opened.
        notes: returns new notes of the operator. It is called at each SYNC and must not wait.
    """

    stop: Stop = field(default_factory=Stop)
    confirm: Confirm = lambda words, faults: False
    show: Callable[[Status, float | None], None] = lambda status, left_s: None
    announce: Callable[[Outcome], None] = lambda outcome: None
    note: Callable[[str], None] = lambda text: None
    notes: Callable[[], Sequence[str]] = tuple


def record(
    robot: Robot, place: str, out: Path, options: RecordOptions, operator: UserInterface
) -> tuple[Outcome, RecordedSummary]:
    """Record until the task is done or the operator's `stop` has a reason.

    The robot moves only with `options.track`.

    Parameters
    ----------
    robot : the robot with its `[bus]`.
    place : name of the description in errors.
    out : the recording to write. An existing file is never replaced.
    options : options of the session.
    operator : stops, watches and confirms.

    Returns
    -------
    The outcome, which has the error of a session that was running, and the summary of the
    recording.

    Raises
    ------
    RobotIdimError : options, description, bus or file are refused before the session runs.
    """
    refuse_taken(out)
    file = Location(place).given(
        robot.bus,
        "bus",
        None,
        text="a session, and a dry run too, needs the drives",
        advice="Remove `#: ` in robot.toml, or add them: `robot-identify init --bus BUS.toml`",
    )
    if options.passive and (options.track is not None or options.dry_run):
        raise RefusedError(
            "a passive session never sends",
            what="sending",
            key="passive",
            advice="Remove it, or the other options",
            arguments=("track", "dry_run"),
        )
    Location(place).require(
        options.passive or not file.mapped_by_traffic,
        "mapping",
        "traffic",
        "'table' or 'dictionary'",
        text="an active session cannot use it",
    )
    payload = None if options.payload is None else parse_payload(options.payload, robot)
    task = _task_of(robot, file.sync_period_s, options, operator)
    # The description is resolved before anything opens.
    bus = None if file.mapped_by_traffic else resolve(robot, place)
    if bus is None or options.passive:
        if words := listening_words(file):
            operator.note(words)
        return _listen(robot, place, out, task, operator, payload)
    refuse_load(bus, place)
    with (
        _simulated(bus, robot, out, place, payload)
        if options.dry_run
        else _on_bus(bus, robot, out, place, options, payload)
    ) as (link, log):
        log.on_status = _left_shown(task, bus.file.sync_period_s, link.now_ns(), operator)
        # The recorder's process has started by now, and does not inherit the scheduling.
        with real_time_scheduling() if isinstance(log, ProcessLog) else nullcontext() as granted:
            if granted is not None and isinstance(log, ProcessLog):
                log.event(link.now_ns(), "mark", f"SYNC loop: {scheduling_words(granted)}")
                log.granted(granted)
            outcome = run_active(
                robot, Master(link, bus), log, task, operator.stop, operator.announce
            )
        try:
            return outcome, log.finish(link.now_ns())
        except RobotIdimError as error:
            # The error of the session may be the cause of this one.
            raise outcome.error or error from error


def _left_shown(task: Task, period_s: float, started_ns: int, operator: UserInterface) -> OnStatus:
    """Return a function that shows each status with the seconds that are left of the task."""
    whole_s = task.duration_s if task.reference is None else len(task.reference) * period_s
    return lambda status, now_ns: operator.show(
        status, None if whole_s is None else max(0.0, whole_s - (now_ns - started_ns) * 1e-9)
    )


def _task_of(
    robot: Robot, period_s: float, options: RecordOptions, operator: UserInterface
) -> Task:
    """Return the task in the options.

    Raises
    ------
    RobotIdimError : options cannot be combined, or the reference cannot be followed.
    """
    COMMAND_LINE.require(
        options.track is None or options.duration_s is None,
        "duration_s",
        options.duration_s,
        text="a session with a reference lasts as long as the reference",
        advice="Remove it, or the reference",
        arguments=("track",),
    )
    COMMAND_LINE.require(
        options.track is not None or options.speed == 1.0,
        "speed",
        options.speed,
        text="the factor applies only to a reference",
        advice="Remove it, or pass a reference",
        arguments=("track",),
    )
    COMMAND_LINE.require(
        0 < options.speed <= 1, "speed", options.speed, "greater than 0 and at most 1"
    )
    if options.track is None:
        return Task(duration_s=options.duration_s, notes=operator.notes)
    reference = table_reference(options.track, robot, period_s, options.speed)
    check_limits(reference, robot, period_s, str(options.track))
    task = Task(reference=reference, place=str(options.track), notes=operator.notes)
    if options.dry_run:
        return task
    Location("robot.toml").require(
        not robot.unconfirmed,
        "unconfirmed",
        ", ".join(robot.unconfirmed),
        text="these joints were corrected from a recording, and no person has checked them",
        advice=HOW_TO_CONFIRM,
    )
    lines = lines_to_fill_in(robot)
    Location("robot.toml").require(
        not lines,
        "lines",
        lines,
        text=f"these lines of [bus], [[motor]] and joint limits are marked {FILL_IN}",
        advice="Complete them before motion",
    )
    return replace(
        task, before_motion=lambda master: _before_motion(robot, master, options, operator.confirm)
    )


@contextmanager
def _simulated(
    bus: Bus, robot: Robot, out: Path, place: str, payload: Payload | None
) -> Iterator[tuple[LockStepLink, InlineLog]]:
    """Yield a link to simulated drives in simulated time, and its log."""
    mechanism = driven_plant(robot, bus, payload)
    with closing(
        InlineLog(
            Recorder(
                out,
                describe_loops(robot, mechanism.loops),
                source="dry run on simulated drives",
                place=place,
                payload=payload,
            )
        )
    ) as log:
        link = LockStepLink(SimulatedDrives(robot, bus, mechanism), tap=log.tap)
        if mechanism.warning is not None:
            log.event(link.now_ns(), "warning", f"dry run: {mechanism.warning}")
        yield link, log


@contextmanager
def _on_bus(
    bus: Bus, robot: Robot, out: Path, place: str, options: RecordOptions, payload: Payload | None
) -> Iterator[tuple[Link, ProcessLog]]:
    """Yield a link to the drives, and the recorder in a separate process.

    The link is opened first, so that no file is written without a bus.
    """
    shared = bus.file.interface in SHARED
    with closing(
        open_link(bus.file, passive=False, tap=None if shared else lambda frame: log.tap(frame))
    ) as link:
        role = Role.FED if not shared else Role.OBSERVER if options.track is None else Role.GUARD
        with closing(
            ProcessLog(out, robot, place, role, link.now_ns() - time.monotonic_ns(), payload)
        ) as log:
            yield link, log


def _before_motion(
    robot: Robot, master: Master, options: RecordOptions, confirm: Confirm
) -> list[str]:
    """Check monitoring, homing, joint positions and jitter before a real robot moves.

    It returns texts for `/events`.
    """
    if not options.unsupervised_drives:
        refuse_unsupervised(master)
    confirmed = confirm_motion(robot, master, confirm, reset_faults=options.reset_faults)
    jitter = refuse_jitter(master)
    return [
        f"confirmed: {', '.join(confirmed)}",
        f"SYNC jitter sd {jitter.sd_s * 1e3:.3f} ms, largest {jitter.worst_s * 1e3:.3f} ms, before "
        "motion",
        *([f"{options.track} at {options.speed:g} of its speed"] if options.speed != 1 else []),
        *(
            [f"watchdog: {second_stop(master.bus.file)}"]
            if master.bus.file.interface not in SHARED
            else []
        ),
    ]


def _listen(
    robot: Robot,
    place: str,
    out: Path,
    task: Task,
    operator: UserInterface,
    payload: Payload | None,
) -> tuple[Outcome, RecordedSummary]:
    """Record the frames of the bus. Only the recorder's process opens it, and cannot send."""
    stop, clock = operator.stop, WallClock()
    with closing(
        ProcessLog(out, robot, place, Role.LISTENER, clock.now_ns() - time.monotonic_ns(), payload)
    ) as log:
        started_s, cut_short = time.monotonic(), False
        log.event(clock.now_ns(), "phase", "record")
        try:
            while not stop.reason:
                elapsed_s = time.monotonic() - started_s
                if task.duration_s is not None and elapsed_s >= task.duration_s:
                    break
                for text in task.notes():
                    log.event(clock.now_ns(), "operator", text)
                if (status := log.poll(clock.now_ns())) is not None:
                    operator.show(
                        status, None if task.duration_s is None else task.duration_s - elapsed_s
                    )
                    stop.reason, cut_short = stop.reason or status.ends, bool(status.ends)
                time.sleep(0.02)
        except RobotIdimError as error:
            with suppress(RobotIdimError):
                log.event(clock.now_ns(), "fault", str(error))
            raise
        reason = stop.reason or "finished"
        with suppress(RobotIdimError):
            log.event(clock.now_ns(), "end", reason)
        return Outcome(reason=reason, fault=False, cut_short=cut_short), log.finish(clock.now_ns())


@contextmanager
def stop_on_signals(stop: Stop) -> Iterator[None]:
    """Set `stop` on Ctrl-C, SIGTERM and a closed terminal inside the block.

    If Ctrl-C follows any of them, it requests a quick stop.
    """

    def asked(number: int, _: FrameType | None) -> None:
        stop.at_once |= number == signal.SIGINT and stop.reason.startswith(STOPPED)
        stop.reason = stop.reason or f"{STOPPED} {signal.Signals(number).name}"

    # An ignored SIGHUP stays ignored (`nohup`). SIGINT is handled in background jobs too, although
    # shells ignore it there.
    before = {
        number: signal.signal(number, asked)
        for number in STOPPING
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# Frames of udp_multicast stay on this computer.
WITHOUT_HARDWARE = ("virtual", "udp_multicast")


def replay(
    path: Path, file: BusFile, stop: Stop, *, speed: float = 1.0, onto_bus: bool = False
) -> int:
    """Send the frames that the drives of a recording sent, and its SYNCs, with the same timing.

    Commands are never sent.

    Parameters
    ----------
    path : the recording.
    file : the bus to send on.
    stop : ends the replay.
    speed : factor on the recorded speed.
    onto_bus : True to allow interfaces with hardware.

    Returns
    -------
    The number of frames sent.

    Raises
    ------
    RobotIdimError : `speed` or the interface is refused, the recording contains no frames of
        drives, another node sends before or between these frames, or the bus does not accept them.
    """
    COMMAND_LINE.require(speed > 0, "speed", speed, "greater than 0")
    if file.interface not in WITHOUT_HARDWARE and not onto_bus:
        raise RefusedError(
            "hardware may be connected to this bus",
            what="sending",
            key="interface",
            value=file.interface,
            advice=f"Use {' or '.join(WITHOUT_HARDWARE)}, or allow this bus",
            arguments=("onto_bus",),
        )
    frames, described = from_drives(read_recording(path), str(path))
    due_s = np.maximum.accumulate((frames["time_ns"] - frames["time_ns"][:1]) * 1e-9 / speed)
    count = 0

    def listen_until(until_s: float) -> None:
        """Wait; raise `RefusedError` at the first frame of another node."""
        while not stop.reason:
            left_s = until_s - time.monotonic()
            frame = link.take(min(max(left_s, 0.0), 0.1))
            if frame is not None and not frame.flags & ERROR:
                raise RefusedError(
                    f"the bus is not idle ({service_of(frame, described.sync_can_id)} received); "
                    f"{f'{count} frames were' if count else 'nothing was'} sent",
                    what="sending",
                    place=f"{file.interface} {file.channel}",
                    advice="Disconnect the other nodes",
                )
            if left_s <= 0:
                return

    with closing(open_link(file, passive=False)) as link:
        listen_until(time.monotonic() + max(LISTEN_S, 1.5 * described.heartbeat_s))
        start_s = time.monotonic()
        for row, at_s in zip(frames, due_s.tolist(), strict=True):
            listen_until(start_s + at_s)
            if stop.reason:
                break
            link.send(int(row["can_id"]), row["data"].tobytes()[: row["length"]])
            count += 1
    return count


def from_drives(recording: Recording, place: str) -> tuple[Block, BusFile]:
    """Return the frames that the drives of a recording sent, with SYNC, and the bus description.

    The frames are from the channel with the most frames. The drives are those of the description in
    the recording, with their TPDOs, emergencies, SDO answers and heartbeats. Error frames, remote
    requests and 29-bit frames are left out.

    Raises
    ------
    BadInputError : no frame is left.
    """
    at = Location(place)
    at.require(
        recording.frames,
        text="the recording contains no CAN frames",
        advice="Choose a recording of drives",
    )
    frames = max(recording.frames.values(), key=len)
    _, bus = resolve_mapped(frames, recording.robot, f"{place}: robot.toml")
    ids = [
        bus.file.sync_can_id,
        *(pdo.can_id for drive in bus.drives for pdo in drive.tpdos),
        *(s + drive.node for drive in bus.drives for s in (EMERGENCY, ANSWER, HEARTBEAT)),
    ]
    plain = (frames["flags"] & (EXTENDED | ERROR | REMOTE_REQUEST)) == 0
    found: Block = frames[plain & np.isin(frames["can_id"], ids)]
    at.require(len(found), text="the recording contains neither frames of its drives nor SYNC")
    return found, bus.file
