"""What must hold while drives are enabled. Each function returns the reason to stop, or None."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cia402 import State
from .master import OPERATIONAL, Master
from .robot import Robot

Vector = NDArray[np.float64]

SILENT_SYNCS = 3  # in a row that a drive may leave unanswered
LOST_HEARTBEATS = 3
SPEED_MARGIN = 1.2  # over the limit, for what tracking overshoots
SPEED_SYNCS = 5  # over which speed is measured


@dataclass(kw_only=True)
class Motion:
    """Measured joint positions of the last SYNCs, latest last, and the target that the latest should have reached."""

    measured: list[Vector]
    target: Vector | None = None


def node_fault(master: Master, now_ns: int) -> str | None:
    """Emergencies, resets, lost heartbeats, missed answers, errors of the bus: reasons to end any active session."""
    if master.bus_error is not None:
        return f"bus: {master.bus_error}"
    lost_ns = LOST_HEARTBEATS * master.bus.file.heartbeat_s * 1e9
    for watch in master.nodes:
        node = f"node {watch.drive.node} ({watch.drive.name})"
        if watch.emergency is not None:
            return f"{node}: emergency 0x{watch.emergency:04X}"
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


def motion_fault(master: Master, robot: Robot, motion: Motion) -> str | None:
    """States, limits and following errors: reasons to stop motion."""
    for watch in master.nodes:
        if watch.state is not State.OPERATION_ENABLED:
            told = "unknown" if watch.state is None else watch.state.words
            return f"node {watch.drive.node} ({watch.drive.name}): {told} in motion: expected operation enabled"
    q = motion.measured[-1]
    for i, joint in enumerate(robot.joints):
        unit, largest = joint.position_unit, joint.si("following_error")
        low, high = joint.si("position")
        if not low <= q[i] <= high:
            return f"{joint.name}: position {q[i]:.4g} {unit}: expected {low:.4g} to {high:.4g}"
        if motion.target is not None and abs(q[i] - motion.target[i]) > largest:
            error = abs(q[i] - motion.target[i])
            return f"{joint.name}: following error {error:.4g} {unit}: expected {largest:.4g} at most"
    if len(motion.measured) > SPEED_SYNCS:
        dq = (q - motion.measured[-1 - SPEED_SYNCS]) / (SPEED_SYNCS * master.bus.file.sync_period_s)
        for i, joint in enumerate(robot.joints):
            unit, largest = joint.position_unit, joint.si("speed")
            if abs(dq[i]) > SPEED_MARGIN * largest:
                return f"{joint.name}: speed {abs(dq[i]):.4g} {unit}/s: expected {largest:.4g} at most"
    return None
