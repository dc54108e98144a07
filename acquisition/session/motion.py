"""Enabling and disabling of all drives together, and the guards of motion in between.

While a drive is not enabled, its target follows the measured position. Once it reports operation
enabled, its target stays at the last position before. If the target continued to follow, the arm
could sink when the brake opens, and the drive would detect no following error.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

import numpy as np

from ..arrays import Array
from ..bus import OPERATIONAL, Master, Orders
from ..errors import BusFaultError
from ..protocol import FOLLOWS, REMOTE, Command, State, error_words, status_words, toward
from ..robot import Joint, Robot

# All drives must be enabled, or disabled, within this time.
ENABLE_S = 5.0
# One transition at a time, so that a drive can decelerate and engage its brake
# before voltage is off.
_DOWN: dict[State | None, Command] = {
    State.OPERATION_ENABLED: Command.SWITCH_ON,
    State.SWITCHED_ON: Command.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Command.DISABLE_VOLTAGE,
    State.QUICK_STOP_ACTIVE: Command.DISABLE_VOLTAGE,
}


def all_enabled(master: Master) -> bool:
    """Test whether every drive is in operation enabled."""
    return all(watch.state is State.OPERATION_ENABLED for watch in master.nodes)


def enable(
    master: Master, targets: list[int], in_fault: Collection[int] = ()
) -> Iterator[Orders | None]:
    """Yield commands for each SYNC until every drive is in operation enabled.

    It yields None if nothing is to be sent.

    Parameters
    ----------
    master : has the drives.
    targets : an empty list; it receives the target counts (n) at which the drives are held.
    in_fault : node ids of drives whose faults the operator confirmed; only these are reset.

    Raises
    ------
    BusFaultError : another drive is in fault, or not all drives are enabled after 5 s.
    """
    for k in range(round(ENABLE_S / master.bus.file.sync_period_s)):
        watches = master.nodes
        measured = [watch.counts for watch in watches if watch.counts is not None]
        states = [watch.state for watch in watches if watch.state is not None]
        if len(measured) == len(watches):
            targets[:] = [
                target if watch.state is State.OPERATION_ENABLED else counts
                for watch, target, counts in zip(
                    watches, targets or measured, measured, strict=True
                )
            ]
        if all_enabled(master):
            return
        if not targets or len(states) < len(watches):
            yield None
            continue
        controls = []
        for watch, state in zip(watches, states, strict=True):
            command = toward(state, State.OPERATION_ENABLED)
            if command is Command.FAULT_RESET and watch.drive.node not in in_fault:
                raise BusFaultError(
                    "the drive went into fault after the session began",
                    place=f"node {watch.drive.node} ({watch.drive.name})",
                )
            if state is State.OPERATION_ENABLED:
                command = Command.ENABLE_OPERATION
            elif command is Command.FAULT_RESET and k % 2:
                # A drive acts on the rising edge of this bit, so it is cleared in every other SYNC.
                command = None
            controls.append(command.controlword if command else 0)
        yield list(zip(controls, targets, strict=True))
    late = ", ".join(
        f"node {w.drive.node} {'silent' if w.statusword is None else status_words(w.statusword)}"
        for w in master.nodes
        if w.state is not State.OPERATION_ENABLED
    )
    raise BusFaultError(f"not all drives are enabled after {ENABLE_S:g} s: {late}")


def disable(master: Master, targets: list[int]) -> Iterator[Orders]:
    """Yield commands that hold the targets until every drive is in switch on disabled or fault.

    Parameters
    ----------
    master : has the drives.
    targets : target counts (n).

    Raises
    ------
    BusFaultError : not all drives are in these states after 5 s.
    """
    for _ in range(round(ENABLE_S / master.bus.file.sync_period_s)):
        states = [watch.state for watch in master.nodes]
        if all(state in (State.SWITCH_ON_DISABLED, State.FAULT) for state in states):
            return
        yield [
            (_DOWN.get(state, Command.DISABLE_VOLTAGE).controlword, target)
            for state, target in zip(states, targets, strict=True)
        ]
    raise BusFaultError(f"not all drives are disabled after {ENABLE_S:g} s")


# A single lost frame is not a fault, but so many SYNCs in a row without an answer are.
SILENT_SYNCS = 3
LOST_HEARTBEATS = 3
# The speed may overshoot its limit by this factor while a drive tracks.
SPEED_MARGIN = 1.2
SPEED_SYNCS = 5  # over which speed is measured
# A bit of _OPERATING that is 0 in so many SYNCs in a row is a fault.
CLEAR_SYNCS = 3
# Bits of the statusword that are 1 in operation. Some drives never set them, so a bit is checked
# only once it was 1.
_OPERATING = {
    REMOTE: "does not accept commands from the bus (statusword bit 9, remote, is 0)",
    FOLLOWS: "does not follow its target (statusword bit 12 is 0)",
}


@dataclass(kw_only=True)
class MotionState:
    """The state of a motion for the guards, from the start of enabling on.

    Attributes:
        enabling: True until all drives have been enabled for `enable_watch_s`.
        start: joint positions (n,) when enabling began, rad or m.
        measured: joint positions (n,) at the last SYNCs, latest last.
        target: target position (n,) that belongs to the last measured one; None without a target.
        enabled: node ids of drives that have been enabled.
        bits_seen: bits of the statusword that were set while a drive was enabled, by node id.
        clear_syncs: SYNCs in a row with a cleared bit, by node id and bit.
    """

    enabling: bool = True
    start: Array | None = None
    measured: list[Array] = field(default_factory=list)
    target: Array | None = None
    enabled: set[int] = field(default_factory=set)
    bits_seen: dict[int, int] = field(default_factory=dict)
    clear_syncs: dict[tuple[int, int], int] = field(default_factory=dict)


def node_fault(master: Master, now_ns: int) -> BusFaultError | None:
    """Return the fault of a node or the bus that ends any active session; else None.

    Faults are an emergency, a restart, a lost heartbeat, missing answers, and errors of the bus.
    """
    if master.bus_error is not None:
        return BusFaultError(master.bus_error, place="bus")
    lost_ns = LOST_HEARTBEATS * master.bus.file.heartbeat_s * 1e9
    for watch in master.nodes:
        node = f"node {watch.drive.node} ({watch.drive.name})"
        if watch.emergency is not None:
            return BusFaultError(
                f"the drive reports emergency {error_words(watch.emergency)}", place=node
            )
        if watch.booted:
            return BusFaultError("the drive has restarted", place=node)
        if watch.started and watch.nmt != OPERATIONAL:
            return BusFaultError(
                f"the drive has left operational (NMT state {watch.nmt})", place=node
            )
        # A heartbeat that left the drive before START may arrive after it.
        if watch.unstarted >= LOST_HEARTBEATS:
            return BusFaultError(
                f"the drive is not operational {watch.unstarted} heartbeats after START (NMT state "
                f"{watch.nmt})",
                place=node,
            )
        if watch.beats and watch.heard_ns and now_ns - watch.heard_ns > lost_ns:
            return BusFaultError(
                f"the drive has sent no heartbeat for {(now_ns - watch.heard_ns) * 1e-9:.2f} s",
                place=node,
            )
        if watch.silent_syncs >= SILENT_SYNCS:
            return BusFaultError(
                f"the drive has not answered {watch.silent_syncs} SYNCs in a row", place=node
            )
    return None


def state_fault(master: Master, motion: MotionState) -> BusFaultError | None:
    """Return the fault of a drive that does not follow commands, by its statusword; else None.

    The drive has left operation enabled, or has cleared a bit of `_OPERATING`.
    """
    for watch in master.nodes:
        node, word = watch.drive.node, watch.statusword
        name = f"node {node} ({watch.drive.name})"
        if watch.state is not State.OPERATION_ENABLED or word is None:
            if not motion.enabling or node in motion.enabled:
                return BusFaultError(
                    "the drive has left operation enabled in motion: "
                    f"{'unknown state' if word is None else status_words(word)}",
                    place=name,
                )
            continue
        motion.enabled.add(node)
        motion.bits_seen[node] = motion.bits_seen.get(node, 0) | word
        for bit, text in _OPERATING.items():
            clear = (
                motion.clear_syncs.get((node, bit), 0) + 1
                if motion.bits_seen[node] & ~word & bit
                else 0
            )
            motion.clear_syncs[node, bit] = clear
            if clear >= CLEAR_SYNCS:
                return BusFaultError(f"the drive {text} for {clear} SYNC periods", place=name)
    return None


def joint_fault(master: Master, robot: Robot, motion: MotionState) -> BusFaultError | None:
    """Return the fault of a joint that exceeds a limit; else None.

    The limits are those of position, speed, following error, and motion while drives are enabled.
    """
    q, file = motion.measured[-1], master.bus.file
    before = motion.measured[-1 - SPEED_SYNCS] if len(motion.measured) > SPEED_SYNCS else None
    dq = None if before is None else (q - before) / (SPEED_SYNCS * file.sync_period_s)
    enabling = {
        "revolute": float(np.radians(file.enable_motion_deg)),
        "prismatic": file.enable_motion_m,
    }
    for i, joint in enumerate(robot.joints):
        low, high = joint.si("position")
        if not low <= q[i] <= high:
            return _limit_fault(
                joint, "position", q[i], joint.position_unit, f"{low:.4g} to {high:.4g}"
            )
        moved = q[i] - motion.start[i] if motion.enabling and motion.start is not None else None
        behind = abs(q[i] - motion.target[i]) if motion.target is not None else None
        speed = abs(dq[i]) if dq is not None else None
        for key, value, largest, margin, per in (
            ("motion while drives were enabled", moved, enabling[joint.type], 1.0, ""),
            ("following error", behind, joint.si("following_error"), 1.0, ""),
            ("speed", speed, joint.si("speed"), SPEED_MARGIN, "/s"),
        ):
            if value is not None and abs(value) > margin * largest:
                return _limit_fault(
                    joint, key, value, f"{joint.position_unit}{per}", f"at most {largest:.4g}"
                )
    return None


def _limit_fault(joint: Joint, key: str, value: float, unit: str, expected: str) -> BusFaultError:
    return BusFaultError(
        place=joint.name,
        key=key,
        value=float(value),
        shown=f"{value:.4g} {unit}",
        expected=expected,
    )
