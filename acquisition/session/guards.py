"""Conditions that must hold while drives are enabled. Each function returns the reason to stop, or None."""

from dataclasses import dataclass, field

import numpy as np

from ..arrays import Array
from ..master import FOLLOWS, OPERATIONAL, REMOTE, Master, error_words, status_words
from ..protocol import State
from ..robot import Joint, Robot

SILENT_SYNCS = 3  # in a row that a drive may leave unanswered
LOST_HEARTBEATS = 3
SPEED_MARGIN = 1.2  # times the limit: the speed may overshoot while tracking
SPEED_SYNCS = 5  # over which speed is measured
CLEAR_SYNCS = 3  # in a row in which a bit of _OPERATING is 0
# Bits of the statusword that are 1 in operation. Some drives never set them: only a bit that was 1 before is checked.
_OPERATING = {
    REMOTE: "does not take commands from the bus (statusword bit 9, remote, is 0)",
    FOLLOWS: "does not follow its target (statusword bit 12 is 0)",
}


@dataclass(kw_only=True)
class MotionState:
    """State of the motion that the guards compare with, from the start of enabling on.

    Attributes:
        enabling: until all drives are enabled.
        start: joint positions (n,) when enabling began.
        measured: joint positions of the last SYNCs, latest last.
        target: target position (n,) of the drives, None where they have none.
        enabled: nodes that have been enabled.
        seen: bits of the statusword that each node has set while it was enabled.
        clear: number of SYNCs in a row in which each (node, bit) was 0.
        noted: node and text of the warnings that were recorded.
    """

    enabling: bool = True
    start: Array | None = None
    measured: list[Array] = field(default_factory=list)
    target: Array | None = None
    enabled: set[int] = field(default_factory=set)
    seen: dict[int, int] = field(default_factory=dict)
    clear: dict[tuple[int, int], int] = field(default_factory=dict)
    noted: set[tuple[int, str]] = field(default_factory=set)


def node_fault(master: Master, now_ns: int) -> str | None:
    """Emergency, restart, lost heartbeat, missed answers or error of the bus: the reason to end any active session, or None."""
    if master.bus_error is not None:
        return f"bus: {master.bus_error}"
    lost_ns = LOST_HEARTBEATS * master.bus.file.heartbeat_s * 1e9
    for watch in master.nodes:
        node = f"node {watch.drive.node} ({watch.drive.name})"
        if watch.emergency is not None:
            return f"{node}: emergency {error_words(watch.emergency)}"
        if watch.booted:
            return f"{node}: has restarted"
        if watch.started and watch.nmt != OPERATIONAL:
            return f"{node}: left operational (NMT state {watch.nmt})"
        # A heartbeat that left the drive before START may arrive after it.
        if watch.unstarted >= LOST_HEARTBEATS:
            return f"{node}: not operational {watch.unstarted} heartbeats after START (NMT state {watch.nmt})"
        if watch.heard_ns and now_ns - watch.heard_ns > lost_ns:
            return f"{node}: heartbeat lost for {(now_ns - watch.heard_ns) * 1e-9:.2f} s"
        if watch.silent_syncs >= SILENT_SYNCS:
            return f"{node}: {watch.silent_syncs} SYNC not answered"
    return None


def motion_fault(master: Master, robot: Robot, motion: MotionState) -> str | None:
    """State, limit or following error: the reason to stop motion, or None. Called once per SYNC."""
    return state_fault(master, motion) or joint_fault(master, robot, motion)


def state_fault(master: Master, motion: MotionState) -> str | None:
    """A drive has left operation enabled, or its statusword shows that it does not follow commands: the reason, or None."""
    for watch in master.nodes:
        node, word = watch.drive.node, watch.statusword
        name = f"node {node} ({watch.drive.name})"
        if watch.state is not State.OPERATION_ENABLED or word is None:
            if not motion.enabling or node in motion.enabled:
                state = "unknown" if word is None else status_words(word)
                return f"{name}: {state} in motion: expected operation enabled"
            continue
        motion.enabled.add(node)
        motion.seen[node] = motion.seen.get(node, 0) | word
        for bit, text in _OPERATING.items():
            clear = motion.clear.get((node, bit), 0) + 1 if motion.seen[node] & ~word & bit else 0
            motion.clear[node, bit] = clear
            if clear >= CLEAR_SYNCS:
                return f"{name}: {text} for {clear} SYNC"
    return None


def joint_fault(master: Master, robot: Robot, motion: MotionState) -> str | None:
    """Limits of position, speed, following error, and of motion while drives are enabled: the reason, or None."""
    q = motion.measured[-1]
    dq = None
    if len(motion.measured) > SPEED_SYNCS:
        dq = (q - motion.measured[-1 - SPEED_SYNCS]) / (SPEED_SYNCS * master.bus.file.sync_period_s)
    for i, joint in enumerate(robot.joints):
        unit = joint.position_unit
        low, high = joint.si("position")
        if not low <= q[i] <= high:
            return f"{joint.name}: position {q[i]:.4g} {unit}: expected {low:.4g} to {high:.4g}"
        largest = _enable_motion(master, joint)
        if motion.enabling and motion.start is not None and abs(q[i] - motion.start[i]) > largest:
            moved = q[i] - motion.start[i]
            return f"{joint.name}: moved {moved:.4g} {unit} while drives were enabled: expected {largest:.4g} at most"
        largest = joint.si("following_error")
        if motion.target is not None and abs(q[i] - motion.target[i]) > largest:
            error = abs(q[i] - motion.target[i])
            return f"{joint.name}: following error {error:.4g} {unit}: expected {largest:.4g} at most"
        largest = joint.si("speed")
        if dq is not None and abs(dq[i]) > SPEED_MARGIN * largest:
            return f"{joint.name}: speed {abs(dq[i]):.4g} {unit}/s: expected {largest:.4g} at most"
    return None


def _enable_motion(master: Master, joint: Joint) -> float:
    """Largest motion of a joint while drives are enabled, rad or m."""
    file = master.bus.file
    return float(np.radians(file.enable_motion_deg) if joint.type == "revolute" else file.enable_motion_m)
