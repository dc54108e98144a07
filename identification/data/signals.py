"""Recording → `Signals`: SI units, a uniform grid, float seconds. The only reader of recordings on this side."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.files import field_of, let_go
from acquisition.recording import OPTIONAL, Recording, read_recording
from acquisition.robot import SIMULATED_CONTROLLER, EffortTiming, ExtraColumn, Robot, extra_columns, robot_from_files

from ..arrays import Array
from ..errors import IdentificationError

ON_GRID = 0.05  # of a period: samples further off a uniform grid are interpolated
LONGEST_GAP = 3.0  # periods between two samples, give or take half of one


@dataclass(frozen=True, kw_only=True)
class SignalEvent:
    """An event of the recording, `t_s` seconds from the first sample: a phase of the session, a warning, a mark."""

    t_s: float
    kind: str
    text: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Signals:
    """What was measured, on a uniform grid.

    Attributes:
        t_s: (N,) time from the first sample, s.
        q: (N, n) measured joint positions, rad or m.
        q_ref: (N, n) reference positions, or None where the recording has none.
        effort: (N, n) joint torques in N m, forces in N; in A or V where the drive gain is not known.
        sample_rate_hz: rate of the grid.
        track: (start, stop) sample range of the recorded tracking phase, or None.
        robot: the robot's description.
        recording: file name of the recording.
        sha256: digest of the recording.
        events: what happened, in the order of the recording.
        health: the recorder's counters by name: t_s (k,) from the first sample, and the counts (k,).
        extras: the drives' extra objects: t_s (k,) from the first sample, and the values (k,) as they were recorded.
        effort_timing: `command` of an instant, held after it; `mean` over the control period about it, as those that this
            package simulates; `measured` at the instant, as in joint states of ROS; or `unknown`.
        provenance: where the efforts come from, in words.
        velocity: (N, n) measured speeds of the joints, rad/s or m/s, or None.
        known_torque: (N, n) torques on the joints that are known and not of the drives, N m or N, or None.
        feedforward: (N, n) what was added to the controller's output, by motor in the unit of the recorded effort, or None.
        began: when the recording began, None where nothing says so.
        off_grid: how far a sample's own time was off the grid at most, in periods; interpolated beyond `ON_GRID`.
    """

    t_s: Array
    q: Array
    q_ref: Array | None
    effort: Array
    sample_rate_hz: float
    track: tuple[int, int] | None
    robot: Robot
    recording: str
    sha256: str
    events: tuple[SignalEvent, ...] = ()
    health: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    extras: Mapping[ExtraColumn, tuple[Array, Array]] = field(default_factory=dict)
    effort_timing: EffortTiming = "unknown"
    provenance: str = ""
    velocity: Array | None = None
    known_torque: Array | None = None
    feedforward: Array | None = None
    began: datetime | None = None
    off_grid: float = 0.0

    def __post_init__(self) -> None:
        N, n = self.q.shape
        parts = {name: getattr(self, name) for name in ("t_s", "q", "q_ref", "effort", *OPTIONAL)}
        for name, part in parts.items():
            shape = (N,) if name == "t_s" else (N, n)
            if part is not None and part.shape != shape:
                key = f"{name}.shape"
                raise IdentificationError(place=self.recording, key=key, value=part.shape, expected=str(shape))
        if n != self.robot.n:
            expected = f"{self.robot.n}, as the robot has"
            raise IdentificationError(place=self.recording, key="joints recorded", value=n, expected=expected)
        if self.known_torque is not None and not self.robot.gain_known:
            units = " and ".join(sorted(set(self.robot.effort_units)))
            problem = f"cannot be added to efforts in {units}"
            expected = f"the drive gains of robot {self.robot.name}"
            raise IdentificationError(problem, place=self.recording, key="known_torque", expected=expected)
        for name, array in parts.items():
            if array is not None:
                if not np.isfinite(array).all():
                    row = int(np.argwhere(~np.isfinite(array))[0, 0])
                    raise IdentificationError(
                        place=self.recording, key=f"{name}[{row}]", value=array[row].tolist(), expected="finite numbers"
                    )
                array.flags.writeable = False
                let_go(array)

    @property
    def of_drives(self) -> bool:
        """Whether efforts are objects of drives, which have loops of their own."""
        return ": object " in self.provenance

    @cached_property
    def torque(self) -> Array:
        """What the inverse dynamic model gives (N, n): the efforts of the drives and the known torques."""
        return self.effort if self.known_torque is None else self.effort + self.known_torque

    def __repr__(self) -> str:
        reference = ", with reference" if self.q_ref is not None else ""
        return (
            f"Signals({self.recording}: {self.robot.name}, {len(self.t_s)} samples of {self.robot.n} joints "
            f"at {self.sample_rate_hz:g} Hz{reference})"
        )


def load_signals(path: str | PathLike[str], robot: Robot | None = None) -> Signals:
    """Read a recording.

    Parameters
    ----------
    path : of an MCAP file with joint samples.
    robot : takes the place of the description stored in the recording; it may correct ratios and gains, not units.

    Returns
    -------
    The samples in SI units at the joints, on a uniform grid: interpolated where they are more than 0.05 periods off it.

    Raises
    ------
    AcquisitionError : the file cannot be read.
    IdentificationError : it is cut, has no joint samples or gaps in them, or `robot` has other units than were recorded.
    """
    path = Path(path)
    recording = read_recording(path)
    if recording.cut:
        expected = f"a recording with its end: `robot-acquire recover {path} -o OUT.mcap` keeps what it holds"
        raise IdentificationError("is cut", place=str(path), expected=expected)
    samples = recording.samples
    if samples is None or len(samples) == 0:
        expected = "the channel /samples (`robot-acquire decode` makes it from frames)"
        raise IdentificationError(recording.no_samples, place=str(path), expected=expected)
    stamps = field_of(samples, "stamp_ns")
    grid, rate_hz, off_grid = _grid(stamps, recording.sample_rate_hz, path)
    q, effort = (_at(grid, stamps, field_of(samples, name)) for name in ("position", "effort"))
    fields = samples.dtype.names or ()
    reference = _at(grid, stamps, field_of(samples, "reference")) if "reference" in fields else None
    optional = {name: _at(grid, stamps, field_of(samples, name)) for name in OPTIONAL if name in fields}
    law = recording.robot.files.get(SIMULATED_CONTROLLER)
    if robot is not None and law is not None:  # that of the drives in this recording, whoever describes the robot
        robot = robot_from_files({**robot.files, SIMULATED_CONTROLLER: law}, str(path))
    if robot is not None and robot.n == recording.robot.n:
        # Samples stand at the joint: back to the motors as they were recorded, and out again as `robot` has it.
        was = recording.robot
        _refuse_other_units(was, robot, path)
        q, effort = robot.joint_position(was.motor_position(q)), robot.joint_effort(was.motor_effort(effort))
        reference = None if reference is None else robot.joint_position(was.motor_position(reference))
        if "velocity" in optional:
            optional["velocity"] = robot.joint_velocity(was.motor_velocity(optional["velocity"]))
    return Signals(
        t_s=grid * 1e-9,
        q=q,
        q_ref=reference,
        effort=effort,
        sample_rate_hz=rate_hz,
        track=_phase(recording, "track", grid, int(stamps[0])),
        robot=robot or recording.robot,
        recording=path.name,
        sha256=recording.sha256,
        events=tuple(
            SignalEvent(t_s=1e-9 * (event.stamp_ns - int(stamps[0])), kind=event.kind, text=event.text)
            for event in recording.events
        ),
        health=_health(recording, int(stamps[0])),
        extras=_extras(samples, recording.robot),
        effort_timing=recording.effort_timing,
        provenance=recording.metadata.get("effort_provenance", ""),
        began=recording.began,
        off_grid=off_grid,
        **optional,
    )


def _refuse_other_units(was: Robot, robot: Robot, path: Path) -> None:
    """Another description may correct ratios and gains; what was recorded in volts never becomes amperes, nor rad m."""
    for kind, old, new in (
        ("motor", [(m.name, m.recorded_unit) for m in was.motors], [m.recorded_unit for m in robot.motors]),
        ("joint", [(j.name, j.position_unit) for j in was.joints], [j.position_unit for j in robot.joints]),
    ):
        for (name, before), now in zip(old, new, strict=True):
            if before != now:
                key = f"unit of {kind} {name} in robot {robot.name}"
                raise IdentificationError(place=str(path), key=key, value=now, expected=f"{before}, as recorded")


def _grid(stamps: NDArray[np.int64], nominal_hz: float, path: Path) -> tuple[Array, float, float]:
    """A uniform grid (N,) in ns from the first of `stamps`, its rate in Hz, and how far a stamp is off it, in periods.

    The grid is the stamps themselves where they lie on one. Where samples are missing it has the nominal rate, if that is
    theirs within 10 %. Refuses gaps over three periods and time that does not grow.
    """
    if len(stamps) < 2:
        raise IdentificationError(place=str(path), key="samples", value=len(stamps), expected="a trajectory")
    steps = np.diff(stamps)
    period = float(np.median(steps))
    bad = np.flatnonzero((steps <= 0) | (steps > (LONGEST_GAP + 0.5) * max(period, 1.0)))
    if bad.size:
        k = int(bad[0])
        raise IdentificationError(
            f"{bad.size} gap(s), the first after {1e-9 * (stamps[k] - stamps[0]):.4f} s: a step of {steps[k] * 1e-6:.3f} ms",
            place=str(path),
            key="samples",
            expected=f"{period * 1e-6:.3f} ms throughout, and at most {LONGEST_GAP:g} times that",
        )
    since = np.asarray(stamps - stamps[0], dtype=np.float64)
    whole = steps.max() <= 1.5 * period or len(stamps) < 3
    if whole:
        period = float(since[-1]) / (len(stamps) - 1)
    else:
        period = 1e9 / nominal_hz if abs(1e9 / nominal_hz / period - 1) < 0.1 else period
    at = since / period
    nearest = np.arange(len(stamps)) if whole else np.rint(at)
    off = at - nearest
    off_grid = float(np.abs(off - (off.min() + off.max()) / 2).max()) if whole else float(np.abs(off).max())
    if whole and off_grid <= ON_GRID:
        return since, round(1e9 / period, 6), off_grid
    grid = np.arange(int(at[-1] + 1e-9) + 1, dtype=np.float64) * period
    return grid, round(1e9 / period, 6), off_grid


def _at(grid: Array, stamps: NDArray[np.int64], x: Array) -> Array:
    """x (N, n), sampled at `stamps`, at the instants of the grid: as it is, or a cubic spline in between."""
    since = (stamps - stamps[0]).astype(float)
    if len(grid) == len(since) and (grid == since).all():
        return x
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(since, x)(grid))


def _health(recording: Recording, first_ns: int) -> dict[str, tuple[Array, Array]]:
    """The recorder's counters by name, over seconds from the first sample."""
    names = dict.fromkeys(name for health in recording.health for name in health.counters)
    found = {}
    for name in names:
        rows = [(1e-9 * (h.stamp_ns - first_ns), h.counters[name]) for h in recording.health if name in h.counters]
        t_s, counts = np.array(rows).T
        found[name] = (t_s, counts)
    return found


def _extras(samples: NDArray[np.void], robot: Robot) -> dict[ExtraColumn, tuple[Array, Array]]:
    """The extra objects of the drives at the samples' own times."""
    if "extra" not in (samples.dtype.names or ()):
        return {}
    t_s = 1e-9 * (samples["stamp_ns"] - samples["stamp_ns"][0])
    return {column: (t_s, x) for column, x in zip(extra_columns(robot), samples["extra"].T, strict=True)}


def _phase(recording: Recording, name: str, grid: Array, first_ns: int) -> tuple[int, int] | None:
    """Sample range of a session phase: from the event that begins it to the next phase's event."""
    phases = [(event.stamp_ns, event.text) for event in recording.events if event.kind == "phase"]
    for k, (begin_ns, phase) in enumerate(phases):
        if phase == name:
            end_ns = phases[k + 1][0] if k + 1 < len(phases) else first_ns + int(grid[-1]) + 1
            start, stop = np.searchsorted(grid, [begin_ns - first_ns, end_ns - first_ns])
            return (int(start), int(stop)) if stop > start else None
    return None
