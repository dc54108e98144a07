"""CiA 402 drives that move a plant: in lock-step with a session, or in real time for any master.

At SYNC a drive samples, answers, and applies the targets received since the last SYNC. Then the
plant is stepped by one period. The time is that of the received frames, so a run in lock-step
repeats bit for bit.
"""

from collections import deque
from collections.abc import Callable, Mapping
from contextlib import closing

import numpy as np

from .. import protocol as cia
from ..arrays import Array, Bools, Ints
from ..bus import Frame, Tap, open_link
from ..recording import SENT
from ..robot import Bus, Robot, axis_index
from .mechanism import SUBSTEPS, DrivenPlant, cubic, driven_plant
from .node import Sent, SimulatedNode, Supervision, simulated_node

# The window of a drive (6065h) is larger by this factor than the following error limits of its
# joints, so that the session reacts first.
WINDOW_FACTOR = 2
# With these values of 605Ah a drive stays in quick stop active at standstill. Smaller values lead
# to switch on disabled.
QUICK_STOP_STAYS = range(5, 9)


class SimulatedDrives:
    """All drives of a robot, without I/O and without a clock.

    `receive` takes a frame and returns the frames that the drives send. The drives move `mechanism`
    (default: `driven_plant` of the description). Unless they are `supervised`, they detect neither
    a lost SYNC, nor a lost master (no 1016h, 6007h is 0), nor a following error (6065h is off).

    Attributes:
        nodes: the drives, in the order of the motors.
        bus: description of the bus and its drives.
        plant: the mechanism that they move.
    """

    def __init__(
        self,
        robot: Robot,
        bus: Bus,
        mechanism: DrivenPlant | None = None,
        *,
        supervised: bool = True,
    ) -> None:
        self.nodes = [simulated_node(drive) for drive in bus.drives]
        for node, file in zip(self.nodes, bus.file.drive, strict=True):
            if file.homed is not None:
                node.set_homed(file.homed)
        # Only the joints that a motor moves count for it. Others may have no limit.
        following = [
            sum(abs(r) * (joint.si("following_error") or np.inf) for r, joint in moved if r)
            for moved in (zip(row, robot.joints, strict=True) for row in robot.R)
        ]
        self._supervisions = [
            Supervision(
                node,
                WINDOW_FACTOR * limit * node.drive.position_codec.counts_per_unit,
                supervised=supervised,
            )
            for node, limit in zip(self.nodes, following, strict=True)
        ]
        mechanism = mechanism or driven_plant(robot, bus)
        self.bus, self.plant, self._loops = bus, mechanism.plant, mechanism.loops
        self._robot, self._period_s = robot, bus.file.sync_period_s
        codecs = [drive.position_codec for drive in bus.drives]
        self._positions = cia.PositionCodec(
            counts_per_unit=np.array([c.counts_per_unit for c in codecs]),
            sign=np.array([c.sign for c in codecs]),
            zero_counts=np.array([c.zero_counts for c in codecs]),
        )
        self._quick_stop = np.abs(robot.R) @ [
            joint.si("acceleration") or 10.0 for joint in robot.joints
        ]
        for node, limit in zip(self.nodes, self._quick_stop, strict=True):
            # The decelerations are the acceleration limit of the motor in rad/s² or m/s², as they
            # would be set when an arm is commissioned.
            keys = [
                (axis_index(node.drive, index), 0)
                for index in (cia.QUICK_STOP_DECELERATION, cia.PROFILE_DECELERATION)
            ]
            unit = _ramp(node, node.values | dict.fromkeys(keys, 1))
            for key in [key for key in keys if key in node.values and unit]:
                node.values[key] = node.initial[key] = int(
                    cia.saturated(np.array(limit / unit), "U32")
                )

        self._reports_demand = np.array([drive.reports_demand for drive in bus.file.drive])
        self._next_heartbeat = [0] * robot.n
        # State of the loops: target, travel to it, speed at it (times the period), integral of the
        # error, efforts, and brakes.
        self._target, self._travel, self._speed, self._integral = np.zeros((4, robot.n))
        self._actual, self._reported = np.zeros((2, robot.n))
        self._held = np.ones(robot.n, np.bool_)

    def set_heartbeats(self, every_ms: int) -> None:
        """Set the heartbeat time of drives whose dictionary has 0 in 1017h.

        It is used from the next boot on.
        """
        for node in self.nodes:
            if node.initial.get((cia.HEARTBEAT_TIME, 0)) == 0:
                node.initial[cia.HEARTBEAT_TIME, 0] = every_ms

    def boot(self) -> Sent:
        """Boot all drives, and return their boot-up messages."""
        sent = [frame for node in self.nodes for frame in node.boot()]
        self._sample()
        return sent

    def receive(self, now_ns: int, can_id: int, data: bytes) -> Sent:
        """Return the frames that the drives send in response to a frame."""
        if can_id == self.bus.file.sync_can_id:
            return self._sync(now_ns)
        if cia.HEARTBEAT < can_id < cia.HEARTBEAT + 0x80 and data:
            for supervision in self._supervisions:
                supervision.heartbeat(now_ns, can_id - cia.HEARTBEAT)
        return [frame for node in self.nodes for frame in node.receive(can_id, data)]

    def due_ns(self) -> int | None:
        """Return when `advance` must be called next; None if nothing is due."""
        times = [
            *(t for i, t in enumerate(self._next_heartbeat) if self._heartbeat_ns(i)),
            *(due for one in self._supervisions if (due := one.due_ns()) is not None),
        ]
        return min(times, default=None)

    def advance(self, now_ns: int) -> Sent:
        """Return the heartbeats that are due.

        Drives that monitor SYNC or a master react if it is lost.
        """
        sent: Sent = []
        for i, node in enumerate(self.nodes):
            every_ns = self._heartbeat_ns(i)
            if node.boot_up_counts:
                node.boot_up_counts, self._next_heartbeat[i] = False, now_ns + every_ns
            elif every_ns and now_ns >= self._next_heartbeat[i]:
                self._next_heartbeat[i] = now_ns + every_ns
                sent += node.heartbeat()
        for supervision in self._supervisions:
            sent += supervision.advance(now_ns)
        return sent

    def _heartbeat_ns(self, i: int) -> int:
        return self.nodes[i].values.get((cia.HEARTBEAT_TIME, 0), 0) * 1_000_000

    def _sync(self, now_ns: int) -> Sent:
        for supervision in self._supervisions:
            supervision.sync_ns = now_ns
        self._sample()
        sent: Sent = []
        moving = any(node.operational for node in self.nodes)
        behind = np.where(self._held, 0.0, self._target - self._measured()[0])
        for i, node in enumerate(self.nodes):
            node.tick()
            if node.operational:
                sent += self._supervisions[i].follow(
                    behind[i] * node.drive.position_codec.counts_per_unit
                )
                sent += self._answer(i, now_ns)
        if moving:
            self._move()
        return sent

    def _answer(self, i: int, now_ns: int) -> Sent:
        """Return the TPDOs of drive `i`, and apply its RPDOs since the last SYNC."""
        sent = self.nodes[i].answers()
        self.nodes[i].apply()
        return sent

    def _move(self) -> None:
        """Step the control loops and the plant by one period."""
        T = self._period_s
        stopping = np.array([node.state is cia.State.QUICK_STOP_ACTIVE for node in self.nodes])
        enabled = (
            np.array([node.state is cia.State.OPERATION_ENABLED for node in self.nodes]) | stopping
        )
        # If the plant prescribes its efforts, the control loops have no effect.
        if self.plant.prescribed_effort() is not None:
            self.plant.step(self._actual, ~enabled | stopping, T)
            return
        position, _ = self._measured()
        # A drive that was enabled at this SYNC starts at its measured position, so that it does not
        # jump.
        start = np.where(self._held, position, self._target)
        before = np.where(self._held, 0.0, self._travel)
        # In a quick stop the speed of the target falls by the deceleration that 605Ah selects, or
        # else by the acceleration limit.
        stated = np.array([_ramp(node, node.values) for node in self.nodes])
        ramps = np.where(stated, stated, self._quick_stop)
        slower = np.sign(before) * np.maximum(np.abs(before) - ramps * T**2, 0.0)
        target = np.where(stopping, start + slower, self._targets(position, enabled & ~stopping))
        travel = np.where(enabled, target - start, 0.0)
        first, last = travel, travel
        # The end speeds are those of the parabola through a target and the two before it.
        if self._loops.smooth:
            first, last = self._speed, np.where(enabled, 1.5 * travel - 0.5 * before, 0.0)
        self._run_loops(start, enabled, lambda share: cubic(share, travel, first, last))
        self._target, self._travel, self._speed, self._held = target, travel, last, ~enabled
        for i, node in enumerate(self.nodes):
            option = node.values.get((cia.QUICK_STOP_OPTION, 0), 2)
            if stopping[i] and travel[i] == 0.0 and option not in QUICK_STOP_STAYS:
                node.state = cia.State.SWITCH_ON_DISABLED

    def _run_loops(
        self, start: Array, enabled: Bools, way_at: Callable[[float], tuple[Array, Array]]
    ) -> None:
        """Move the plant by the control loops during one period.

        Parameters
        ----------
        start : (n,) positions of the motors at the start, rad or m.
        enabled : (n,) True for drives that are enabled.
        way_at : returns the distance of the reference from `start` (n,), and its speed, at a share
            of the period.
        """
        loops, T = self._loops, self._period_s
        decay, total = np.exp(-T / SUBSTEPS / loops.current_s), np.zeros(len(start))
        for k in range(SUBSTEPS):
            position, dq = self._measured()
            way, speed = way_at((k + 1) / SUBSTEPS)
            error, ahead = start + way - position, loops.feedforward * speed / T
            x = loops.position_share * error - (1 - loops.feedforward) * dq
            self._integral = np.where(enabled, self._integral + x * T / SUBSTEPS, 0.0)
            demand = np.where(
                enabled,
                loops.position * error
                + loops.velocity * (ahead - dq)
                + loops.integral * self._integral,
                0.0,
            )
            self._actual = demand + (self._actual - demand) * decay
            self.plant.step(self._robot.joint_effort(self._actual[None])[0], ~enabled, T / SUBSTEPS)
            total = total + self._actual
        # A torque demand value (6074h) is that of the last step, so it leads the torque by the
        # delay of the current loop. Any other effort is the mean torque since the last SYNC, which
        # is half a period late.
        self._reported = np.where(self._reports_demand, demand, total / SUBSTEPS)

    def _targets(self, position: Array, enabled: Bools) -> Array:
        """Return motor targets (n,) from 607Ah.

        If a drive is not enabled, or in another mode, its target is the present position.
        """
        mode = cia.Mode.CYCLIC_SYNCHRONOUS_POSITION
        follows = enabled & [n.values.get((cia.MODE_DISPLAY, 0), mode) == mode for n in self.nodes]
        counts = np.array([node.values.get(node.drive.target.key, 0) for node in self.nodes])
        return np.where(follows, self._positions.si(counts), position)

    def _measured(self) -> tuple[Array, Array]:
        """Return measured positions and speeds, each (n,) of the motors."""
        q, dq = self.plant.state()
        return self._positions.si(self._counts(q)), self._robot.motor_velocity(dq)

    def _counts(self, q: Array) -> Ints:
        return self._positions.raw(self._robot.motor_position(q[None])[0])

    def _sample(self) -> None:
        """Write position, effort and speed into the object dictionaries."""
        q, dq = self.plant.state()
        counts, speed, motor = self._counts(q), self._robot.motor_velocity(dq), self._reported
        if (prescribed := self.plant.prescribed_effort()) is not None:
            motor = self._robot.motor_effort(prescribed[None])[0]
        for i, node in enumerate(self.nodes):
            drive = node.drive
            node.values[drive.position.key] = int(counts[i])
            node.values[drive.effort.entry.key] = int(drive.effort.raw(motor[i]))
            for extra in drive.extras:
                if extra.index == axis_index(drive, cia.VELOCITY_ACTUAL):
                    per_unit = drive.position_codec.sign * drive.position_codec.counts_per_unit
                    node.values[extra.key] = int(
                        cia.saturated(np.array(speed[i] * per_unit), extra.type)
                    )


def _ramp(node: SimulatedNode, values: Mapping[tuple[int, int], int]) -> float:
    """Return the quick stop deceleration by `values` of its objects, rad/s² or m/s² of the motor.

    It is 0 if it is unknown.
    """
    objects = {index: values.get((axis_index(node.drive, index), 0)) for index in cia.RAMP_OBJECTS}
    codec = node.drive.position_codec
    return (cia.quick_stop_ramp(objects, codec) or 0.0) / float(codec.counts_per_unit)


# Drives send heartbeats until a master sets another time, so that a master that listens first
# receives some.
IDLE_HEARTBEAT_MS = 200


class LockStepLink:
    """A `MasterLink` to simulated drives, which it boots.

    Time is simulated, and advances only when the link waits. Every run with the same drives gives
    the same frames. `tap` is called with every frame that the link sends or receives.
    """

    def __init__(self, drives: SimulatedDrives, *, tap: Tap | None = None) -> None:
        self.drives, self._time_ns = drives, 1_000_000_000
        self._tap: Tap = tap or (lambda frame: None)
        self._to_drives, self._from_drives = deque[tuple[int, bytes]](), deque(drives.boot())

    def now_ns(self) -> int:
        """Return the simulated time, ns."""
        return self._time_ns

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame to the drives."""
        self._to_drives.append((can_id, data))
        self._tap(Frame(self._time_ns, can_id, data, SENT))

    def receive(self, until_ns: int) -> Frame | None:
        """Return the next frame; None if there is none until `until_ns`."""
        while not self._from_drives:
            if self._to_drives:
                self._from_drives += self.drives.receive(self._time_ns, *self._to_drives.popleft())
                continue
            due_ns = self.drives.due_ns()
            if due_ns is not None and due_ns <= self._time_ns:
                self._from_drives += self.drives.advance(self._time_ns)
            elif self._time_ns >= until_ns:
                return None
            else:
                self._time_ns = (
                    until_ns if due_ns is None else max(min(until_ns, due_ns), self._time_ns + 1)
                )
        frame = Frame(self._time_ns, *self._from_drives.popleft())
        self._tap(frame)
        return frame


def serve(
    drives: SimulatedDrives, stopped: Callable[[], bool], ready: Callable[[], None] = lambda: None
) -> None:
    """Run simulated drives in real time on the bus of their description, for any master.

    Parameters
    ----------
    drives : the drives, which are booted first.
    stopped : called at least every 50 ms; returns True to end the simulation.
    ready : called once the drives have booted.

    Raises
    ------
    BusFaultError : the bus cannot be opened, or fails.
    """
    with closing(open_link(drives.bus.file, passive=False)) as link:
        drives.set_heartbeats(IDLE_HEARTBEAT_MS)
        sent = drives.boot()
        ready()
        while not stopped():
            for can_id, data in sent:
                link.send(can_id, data)
            now_ns = link.now_ns()
            due = drives.due_ns()
            frame = link.receive(
                min(now_ns + 50_000_000, due if due is not None else now_ns + 50_000_000)
            )
            sent = [] if frame is None else drives.receive(link.now_ns(), frame.can_id, frame.data)
            # Heartbeats must be sent on a busy bus, too.
            if frame is None or (due is not None and due <= now_ns):
                sent = sent + drives.advance(link.now_ns())
