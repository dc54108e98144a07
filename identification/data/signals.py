"""Signals: measurements in SI units on a uniform grid, also from arrays in memory."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike

from acquisition.errors import BadInputError, Location
from acquisition.files import release_pages
from acquisition.recording import OPTIONAL, Event, measured_rows
from acquisition.robot import EffortTiming, Payload, Robot, check_recorded_velocities

from ..arrays import Array, Bools

NAME = "arrays"  # in place of a recording's name
MAX_OFF_RATE = 0.05  # relative to the rate of the recording that arrays come from
COLUMNS = ("t_s", "q", "q_ref", "effort", *OPTIONAL)  # fields of `Signals` with one row per sample


@dataclass(frozen=True, kw_only=True, eq=False)
class Signals:
    """Measurements of a recording on a uniform grid: N samples of n joints.

    Attributes:
        t_s: times from the first sample, shape (N,), s.
        q: measured joint positions, shape (N, n), rad or m.
        q_ref: reference positions, shape (N, n), rad or m, or None.
        effort: joint torques, shape (N, n), N m, or forces, N; in A or V if the drive gain is
            unknown.
        sample_rate_hz: sample rate, Hz.
        track: first sample of the tracking phase, and the one after its last, or None.
        robot: the robot, from the description in the recording or from another one.
        recording: file name of the recording.
        sha256: digest of the file; empty for arrays.
        events: phases, warnings and annotations of the session.
        first_ns: timestamp of the first sample, ns.
        health: counters of the recorder by name: times, shape (k,), s, and counts, shape (k,).
        effort_timing: `command`, an effort that holds from its instant; `mean` over the control
            period around the instant, as simulated here; `measured` at the instant, as in ROS joint
            states; or `unknown`.
        provenance: origin of the efforts, in words.
        effort_object: the part of `provenance` that distinguishes efforts.
        velocity: measured joint speeds, shape (N, n), rad/s or m/s, or None.
        known_torque: external torques on the joints, shape (N, n), N m or N, or None.
        feedforward: feed-forward added to the output of the controller, shape (N, n), by motor in
            the unit of the recorded effort, or None.
        payload: payload of the robot; None for no payload.
        began: time at which the recording began; None if unknown.
        off_grid: largest distance of a sample from the grid, in periods. If it is greater than
            `ON_GRID`, samples are interpolated.
        assumed: assumptions of a fit that replace missing values of the description, as warnings.
        measured: mask, shape (N,), True where a sample was measured; others have zero weight. None:
            all were measured.
        unmeasured: how many samples were not measured and why, in words.
        motion_hz: frequency above which positions contain only noise, Hz, if the description gives
            no bandwidth; else None.
    """

    t_s: Array
    q: Array
    q_ref: Array | None = None
    effort: Array
    sample_rate_hz: float
    track: tuple[int, int] | None = None
    robot: Robot
    recording: str
    sha256: str = ""
    events: tuple[Event, ...] = ()
    first_ns: int = 0
    health: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    effort_timing: EffortTiming = "unknown"
    provenance: str = ""
    effort_object: str = ""
    velocity: Array | None = None
    known_torque: Array | None = None
    feedforward: Array | None = None
    payload: Payload | None = None
    began: datetime | None = None
    off_grid: float = 0.0
    assumed: tuple[str, ...] = ()
    measured: Bools | None = None
    unmeasured: str = ""
    motion_hz: float | None = None

    def __post_init__(self) -> None:
        (N, n), place = self.q.shape, Location(self.recording)
        parts = {name: of for name in COLUMNS if (of := getattr(self, name)) is not None}
        for name, array in parts.items():
            shape = (N,) if name == "t_s" else (N, n)
            if array.shape != shape:
                place.refuse(f"{name}.shape", array.shape, f"{shape}, as for q")
        joints = len(self.robot.joints)
        if n != joints:
            place.refuse("joints recorded", n, f"{joints}, as in the robot description")
        if self.known_torque is not None and not self.robot.gain_known:
            place.refuse(
                "known_torque",
                text="cannot be added to efforts in "
                + " and ".join(sorted(set(self.robot.effort_units))),
                advice=f"Specify the drive gains of robot {self.robot.name}",
            )
        for name, array in parts.items():
            if not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0, 0])
                place.refuse(f"{name}[{row}]", array[row].tolist(), "finite numbers")
            array.flags.writeable = False
            release_pages(array)

    def load(self) -> "Signals":
        """Return the signals themselves, as `RecordingFile.load` does."""
        return self

    def with_gains_of(self, robot: Robot) -> "Signals":
        """Return a copy whose efforts follow from the drive gains of another description.

        Parameters
        ----------
        robot : the same robot with other drive gains.
        """
        return replace(
            self, robot=robot, effort=robot.joint_effort(self.robot.motor_effort(self.effort))
        )

    def first(self, N: int) -> "Signals":
        """Return a copy of the first N samples, because a view would keep all of them in memory."""
        parts: dict[str, Any] = {
            name: np.array(of[:N])
            for name in (*COLUMNS, "measured")
            if (of := getattr(self, name)) is not None
        }
        return replace(self, **parts)

    @property
    def of_drives(self) -> bool:
        """True if the efforts are objects of drives, which have internal loops."""
        return ": object " in self.provenance

    @cached_property
    def torque(self) -> Array:
        """Efforts plus external torques, shape (N, n), N m or N: the torque of the model.

        Samples that were not measured are interpolated linearly, because a step would ring in the
        neighbouring rows.
        """
        tau = self.effort if self.known_torque is None else self.effort + self.known_torque
        if self.measured is None:
            return tau
        rows, there = np.arange(len(tau)), np.flatnonzero(self.measured)
        return np.column_stack([np.interp(rows, there, x[there]) for x in tau.T])

    def __repr__(self) -> str:
        return (
            f"Signals({self.recording}: {self.robot.name}, {len(self.t_s)} samples of "
            f"{self.robot.n} joints at {self.sample_rate_hz:g} Hz"
            f"{', with reference' if self.q_ref is not None else ''})"
        )


# Recordings by their positions, to find out if these are passed with another sample rate.
OF_FILES = WeakValueDictionary[int, Signals]()


def signals_from_arrays(
    q: ArrayLike,
    effort: ArrayLike,
    sample_rate_hz: float,
    robot: Robot,
    q_ref: ArrayLike | None = None,
    **columns: ArrayLike | None,
) -> Signals:
    """Make signals from arrays, which are copied.

    If rows are repeated because a log is faster than its robot, only the new rows are used, with a
    warning in `events`. There is another warning if a velocity differs by more than 10 % from the
    derivative of q.

    Parameters
    ----------
    q, effort : (N, n) positions, rad or m, and torques, N m or N; A or V without a drive gain.
    sample_rate_hz : sample rate, Hz.
    robot : the robot.
    q_ref : (N, n) reference positions, rad or m; None for none.
    columns : (N, n) further arrays by their names in `OPTIONAL`.

    Raises
    ------
    BadInputError : as in `identification.fit`.
    """
    from acquisition.importing import grid_of_new_rows

    for name in columns:
        Location(NAME).require(
            name in OPTIONAL, name, expected=", ".join(OPTIONAL), text="is not a column"
        )
    _refuse_rate(sample_rate_hz)
    of_file, doubts = OF_FILES.get(id(q)), list[str]()
    if of_file is not None and abs(sample_rate_hz / of_file.sample_rate_hz - 1) > MAX_OFF_RATE:
        doubts.append(
            f"q was read from {of_file.recording}, recorded at {of_file.sample_rate_hz:.9g} Hz: "
            f"the fit uses this rate, not sample_rate_hz = {sample_rate_hz:g}"
        )
        sample_rate_hz = of_file.sample_rate_hz
    given: dict[str, Any] = {"q": q, "effort": effort, "q_ref": q_ref, **columns}
    arrays: dict[str, Any] = {
        name: _copy(name, given[name], robot.n)
        for name in ("q", "effort", "q_ref", *OPTIONAL)
        if name in ("q", "effort") or given.get(name) is not None
    }
    digest = hashlib.sha256()
    for name, array in arrays.items():
        digest.update((name if name in OPTIONAL else "").encode() + array.tobytes())
    signals = Signals(
        t_s=np.arange(len(arrays["q"])) / sample_rate_hz,
        sample_rate_hz=float(sample_rate_hz),
        robot=robot,
        recording=NAME,
        sha256=digest.hexdigest(),
        **arrays,
    )
    held = grid_of_new_rows(signals.t_s, {**arrays, "position": signals.q}, Location(NAME))
    if held is not None:
        fewer: dict[str, Any] = {name: held.parts[name] for name in arrays}
        signals = replace(
            signals,
            t_s=np.arange(len(fewer["q"])) / held.rate_hz,
            sample_rate_hz=held.rate_hz,
            **fewer,
        )
        doubts += held.warnings
    if signals.velocity is not None:
        doubts += check_recorded_velocities(
            robot, signals.q, signals.velocity, signals.sample_rate_hz, NAME
        )
    measured, text = measured_rows(
        {"stamp_ns": 1e9 * signals.t_s, "position": signals.q, "effort": signals.effort}, robot
    )
    return replace(
        signals,
        measured=measured if text else None,
        unmeasured=text,
        events=tuple(
            Event(stamp_ns=round(1e9 * signals.t_s[-1]), kind="warning", text=doubt)
            for doubt in doubts
        ),
    )


def _refuse_rate(rate_hz: float) -> None:
    """Refuse anything but one rate in Hz, such as timestamps or a period."""
    rate, doubt = np.asarray(rate_hz), ""
    if rate.size > 1 and rate.dtype.kind in "iufM":  # datetimes too
        unit = np.timedelta64(1, "s") if rate.dtype.kind == "M" else 1
        step = float(np.median(np.diff(rate.ravel()) / unit))
        doubt = f"timestamps in s have the rate {1 / step:.6g} Hz" if step > 0 else ""
    Location(NAME).require(
        not rate.ndim and rate.dtype.kind in "iuf" and 0 < rate_hz < np.inf,
        "sample_rate_hz",
        rate_hz,
        "one rate in Hz, greater than 0",
        text=doubt,
        shown=f"{rate.size} values" if rate.size > 1 else "",
    )
    Location(NAME).require(
        rate_hz >= 1,
        "sample_rate_hz",
        rate_hz,
        "1 or greater",
        text=f"a period of this many seconds is a rate of {1 / rate_hz:g} Hz",
    )


def _copy(name: str, array: ArrayLike, n: int) -> Array:
    try:
        copied = np.array(array, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise BadInputError(
            str(error), place=NAME, key=name, expected=f"numbers of shape (N, {n})"
        ) from error
    Location(NAME).require(
        copied.ndim == 2 and copied.shape[1] == n and len(copied) >= 2,
        f"{name}.shape",
        copied.shape,
        f"(N, {n}), one row per sample",
    )
    return copied
