"""Read recordings as `Signals`; check that recordings are of one robot.

No other module of this package reads recordings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any, get_args

import numpy as np

from acquisition.errors import BadInputError, Location
from acquisition.files import field_of
from acquisition.recording import OPTIONAL, Block, Recording, in_gaps, measured_rows, read_recording
from acquisition.robot import (
    SIMULATED_CONTROLLER,
    Controller,
    FrictionTerm,
    Joint,
    Payload,
    Robot,
    parse_payload,
    robot_from_files,
)

from ..arrays import Array
from .signals import OF_FILES, Signals
from .work import Work

ON_GRID = 0.05  # of a period; samples farther from a uniform grid are interpolated
MOST_MISSING = 10.0  # times the rows that exist; after a longer gap it is another recording
JOINT_KEYS = (
    "name",
    "type",
    "dh",
    "zero_deg",
    "zero_m",
    "stribeck_speed_deg_s",
    "stribeck_speed_m_s",
    "rotor_inertia",
)
MOTOR_KEYS = ("name", "ratio", "effort_unit", "drive_gain", "drive_gain_unit")


def load_signals(path: str | PathLike[str], robot: Robot | None = None) -> Signals:
    """Read the signals of a recording.

    Parameters
    ----------
    path : MCAP file with joint samples.
    robot : robot in place of the recorded description. Its ratios and gains may differ, its units
        may not.

    Returns
    -------
    The samples in SI units at the joints, on a uniform grid. They are interpolated if one is more
    than 0.05 periods off the grid.

    Raises
    ------
    BadInputError : the file cannot be read, is truncated, has gaps or no joint samples, or `robot`
        has other units.
    """
    path = Path(path)
    recording, samples = _read(path)
    stamps, fields = field_of(samples, "stamp_ns"), samples.dtype.names or ()
    first_ns, was, since = int(stamps[0]), recording.robot, (stamps - stamps[0]).astype(float)
    grid, rate_hz, off_grid = _grid(since, recording.sample_rate_hz, path)
    rows, text = measured_rows(samples, recording.robot)
    columns = {
        name: _resample(grid, since, field_of(samples, name))
        for name in ("position", "effort", "reference", *OPTIONAL)
        if name in fields
    }
    measured = (np.interp(grid, since, rows) == 1) & ~in_gaps(since, grid)
    assumed: tuple[str, ...] = ()
    if robot is not None:
        robot, assumed = _with_recorded_controller(robot, was, path)
        if robot.n == was.n:
            _refuse_other_units(was, robot, path)
            columns |= _converted(columns, was, robot)
    provenance = recording.metadata.get("effort_provenance", "")
    signals = Signals(
        t_s=grid * 1e-9,
        q=columns.pop("position"),
        q_ref=columns.pop("reference", None),
        effort=columns.pop("effort"),
        sample_rate_hz=rate_hz,
        track=_phase(recording, "track", grid, first_ns),
        robot=robot or was,
        recording=path.name,
        sha256=recording.sha256,
        events=recording.events,
        first_ns=first_ns,
        health=_health(recording, first_ns),
        effort_timing=recording.effort_timing,
        provenance=provenance,
        effort_object=recording.metadata.get("effort_object", provenance),
        payload=recording.payload,
        began=recording.began,
        off_grid=off_grid,
        assumed=assumed,
        measured=None if measured.all() else measured,
        unmeasured=text,
        motion_hz=None,
        **columns,
    )
    OF_FILES[id(signals.q)] = signals
    return signals


def _read(path: Path) -> tuple[Recording, Block]:
    """Read a complete recording and its samples; refuse one without samples."""
    recording = read_recording(path)
    if recording.cut:
        raise BadInputError(
            "is truncated",
            place=str(path),
            advice=f"Repair it first: `robot-acquire import {path} -o OUT.mcap`",
        )
    if recording.samples is None or len(recording.samples) == 0:
        raise BadInputError(
            recording.no_samples,
            place=str(path),
            advice="Make samples from its frames, with a corrected description if necessary: "
            f"`robot-acquire import {path} --robot ROBOT.toml -o OUT.mcap`",
        )
    return recording, recording.samples


def _with_recorded_controller(
    robot: Robot, was: Robot, path: Path
) -> tuple[Robot, tuple[str, ...]]:
    """Return a description with the controller of a dry run, and a warning if it had its own.

    That controller belongs to the recorded drives.
    """
    if (law := was.files.get(SIMULATED_CONTROLLER)) is None:
        return robot, ()
    is_other = robot.controller != Controller(bandwidth_hz=was.controller.bandwidth_hz)
    warning = "the given [controller] is not used: the drives of a dry run have their own"
    return (
        robot_from_files({**robot.files, SIMULATED_CONTROLLER: law}, str(path)),
        (f"{path.name}: {warning}",) * is_other,
    )


def _converted(columns: Mapping[str, Array], was: Robot, robot: Robot) -> dict[str, Array]:
    """Convert samples at the joint back to the motors as recorded, and to joints by `robot`."""
    conversions = {
        "position": (was.motor_position, robot.joint_position),
        "reference": (was.motor_position, robot.joint_position),
        "velocity": (was.motor_velocity, robot.joint_velocity),
        "effort": (was.motor_effort, robot.joint_effort),
    }
    return {
        name: to_joint(to_motor(columns[name]))
        for name, (to_motor, to_joint) in conversions.items()
        if name in columns
    }


def _refuse_other_units(was: Robot, robot: Robot, path: Path) -> None:
    """Refuse a description that changes volts to amperes or rad to m.

    Another description may correct ratios and gains.
    """
    units = (
        [
            *((f"motor {motor.name}", motor.recorded_unit) for motor in of.motors),
            *((f"joint {joint.name}", joint.position_unit) for joint in of.joints),
        ]
        for of in (was, robot)
    )
    for (key, before), (_, now) in zip(*units, strict=True):
        Location(str(path)).require(
            before == now, f"unit of {key} in robot {robot.name}", now, f"{before}, as recorded"
        )


def _grid(since: Array, nominal_hz: float, path: Path) -> tuple[Array, float, float]:
    """Return a uniform grid (N,), its rate in Hz, and the largest offset from it in periods.

    Times are in ns, `since` the first timestamp. Uniform timestamps are the grid. If samples are
    missing, the grid has the nominal rate if that agrees with the timestamps within 10 %.

    Raises
    ------
    BadInputError : time does not increase, or a gap is far longer than all rows together.
    """
    if len(since) < 2:
        Location(str(path)).refuse("samples", len(since), "at least 2")
    steps = np.diff(since)
    period = float(np.median(steps))
    bad = np.flatnonzero((steps <= 0) | (steps > MOST_MISSING * len(since) * max(period, 1.0)))
    if bad.size:
        k = int(bad[0])
        raise BadInputError(
            f"the time step after {1e-9 * since[k]:.4f} s is {steps[k] * 1e-9:.6g} s, but the "
            f"period is {period * 1e-6:.3f} ms",
            place=str(path),
            key="samples",
            advice="Split the recording into one file per motion",
        )
    whole = steps.max() <= 1.5 * period or len(since) < 3
    agreed = 1e9 / nominal_hz if abs(1e9 / nominal_hz / period - 1) < 0.1 else period
    period = float(since[-1]) / (len(since) - 1) if whole else agreed
    at = since / period
    off = at - (np.arange(len(since)) if whole else np.rint(at))
    off_grid = (
        float(np.abs(off - (off.min() + off.max()) / 2).max())
        if whole
        else float(np.abs(off).max())
    )
    grid = (
        since
        if whole and off_grid <= ON_GRID
        else np.arange(int(at[-1] + 1e-9) + 1, dtype=np.float64) * period
    )
    return grid, round(1e9 / period, 6), off_grid


def _resample(grid: Array, since: Array, x: Array) -> Array:
    """Return x (N, n), sampled at `since`, ns, on the grid: unchanged, or by a cubic spline."""
    if len(grid) == len(since) and (grid == since).all():
        return x
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(since, x)(grid))


def _health(recording: Recording, first_ns: int) -> dict[str, tuple[Array, Array]]:
    """Return the recorder's counters by name, over time in s from the first sample."""
    rows = [(1e-9 * (one.stamp_ns - first_ns), one.counters) for one in recording.health]
    return {
        name: (
            np.array([t_s for t_s, counters in rows if name in counters]),
            np.array([float(counters[name]) for _, counters in rows if name in counters]),
        )
        for name in dict.fromkeys(name for _, counters in rows for name in counters)
    }


def _phase(recording: Recording, name: str, grid: Array, first_ns: int) -> tuple[int, int] | None:
    """Return the sample range of a session phase, from its event to that of the next phase."""
    phases = [(event.stamp_ns, event.text) for event in recording.events if event.kind == "phase"]
    for k, (begin_ns, phase) in enumerate(phases):
        if phase == name:
            end_ns = phases[k + 1][0] if k + 1 < len(phases) else first_ns + int(grid[-1]) + 1
            start, stop = np.searchsorted(grid, [begin_ns - first_ns, end_ns - first_ns])
            return (int(start), int(stop)) if stop > start else None
    return None


@dataclass(frozen=True, kw_only=True)
class RecordingFile:
    """A recording on disk, which each process that needs it reads from the same path.

    Attributes:
        path: path of the file.
        description: files, by name, of a description that replaces the recorded one; None for the
            recorded one.
        payload: payload that replaces the recorded one, as for the option `--payload`, or `none`,
            or `unknown`; None for the recorded one.
    """

    path: str
    description: tuple[tuple[str, bytes], ...] | None = None
    payload: str | None = None

    @classmethod
    def at(
        cls, path: Path, robot: Robot | None = None, payload: str | None = None
    ) -> "RecordingFile":
        """Return the recording at a path.

        Parameters
        ----------
        path : path of the MCAP file.
        robot : robot in place of the recorded description.
        payload : payload in place of the recorded one, as `KG@X,Y,Z` (kg and m), `none` or
            `unknown`.
        """
        return cls(
            path=str(path.absolute()),
            description=None if robot is None else tuple(robot.files.items()),
            payload=payload,
        )

    def load(self) -> Signals:
        """Read the signals, with errors as for `load_signals`."""
        signals = load_signals(
            self.path,
            robot_from_files(dict(self.description), self.path) if self.description else None,
        )
        match self.payload:
            case None:
                return signals
            case "none":
                payload = None
            case "unknown":
                payload = Payload(mass_kg=None, frame=signals.robot.payload.frame)
            case text:
                payload = parse_payload(text, signals.robot)
        return replace(signals, payload=payload)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recordings:
    """Recordings of one robot that are fitted together.

    Attributes:
        sources: the recordings, read or not.
        work: where their tasks run.
    """

    sources: tuple[Signals | RecordingFile, ...]
    work: Work = field(default_factory=Work)


def check_one_robot(recordings: Sequence[Signals]) -> None:
    """Refuse recordings of different robots, or the same recording twice."""
    first, seen = recordings[0], {recordings[0].sha256: recordings[0].recording}
    for other in recordings[1:]:
        place = Location(other.recording)
        place.require(
            not other.sha256 or other.sha256 not in seen,
            text=f"has the same content as {seen.get(other.sha256)}",
            advice="Pass each recording once",
        )
        seen[other.sha256] = other.recording
        place.require(
            other.robot.n == first.robot.n,
            "joints",
            other.robot.n,
            f"{first.robot.n}, as in {first.recording}",
        )
        each, wanted_of = _identity(other.robot, first.robot), _identity(first.robot, first.robot)
        for (key, value), (_, wanted) in zip(each, wanted_of, strict=True):
            place.require(
                value == wanted,
                key,
                value,
                f"{wanted!r}, as in {first.recording}",
                advice="Fit recordings of different robots separately",
            )


def _identity(robot: Robot, first: Robot) -> list[tuple[str, Any]]:
    """Return keys and values that must be equal to those of the `first` robot."""
    return [
        *(
            (
                f"joint {joint.name}: {name}",
                _friction(joint) if name == "friction" else getattr(joint, name),
            )
            for joint in robot.joints
            for name in (*JOINT_KEYS, "friction")
        ),
        *(
            (f"motor {motor.name}: {name}", getattr(motor, name))
            for motor in robot.motors
            for name in MOTOR_KEYS
        ),
        ("gravity_m_s2", np.asarray(robot.gravity).tolist()),
        ("motor_matrix", np.asarray(robot.R).tolist()),
        ("urdf", "the same" if robot.urdf == first.urdf else "another"),
    ]


def _friction(joint: Joint) -> tuple[str, ...]:
    """Return the friction terms of a joint in a fixed order, which makes equal ones comparable."""
    terms = tuple(term for term in get_args(FrictionTerm) if term in joint.terms)
    return ("for each direction", *terms) if joint.one_sided else terms
