"""Arrays in memory → `Signals`."""

import hashlib
import math
from dataclasses import replace
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from acquisition.recording import OPTIONAL
from acquisition.robot import Robot, check_recorded_velocities

from ..arrays import Array
from ..errors import IdentificationError
from .signals import SignalEvent, Signals

NAME = "arrays"  # stands where the name of a recording stands


class OptionalColumns(TypedDict, total=False):
    """Arrays (N, n) that may stand beside position and effort, by the names that they have in a recording."""

    velocity: ArrayLike | None
    known_torque: ArrayLike | None
    feedforward: ArrayLike | None


def signals_from_arrays(
    q: ArrayLike,
    effort: ArrayLike,
    sample_rate_hz: float,
    robot: Robot,
    q_ref: ArrayLike | None = None,
    **columns: Unpack[OptionalColumns],
) -> Signals:
    """Signals out of arrays that are copied.

    Parameters
    ----------
    q, q_ref : (N, n) measured and reference positions of the joints, rad or m.
    effort : (N, n) torques at the joint in N m, forces in N; in A or V where `robot` has no drive gain.
    sample_rate_hz : rate of the N samples.
    robot : its description, of n joints.
    columns : (N, n) `velocity` of the joints, rad/s or m/s; `known_torque` on the joints that is not of the drives, N m or N;
        `feedforward` that was added to the controller's output, by motor in the unit of its effort.

    Returns
    -------
    Signals : a velocity that is over 10 % off the derivative of q is a warning among its events.

    Raises
    ------
    IdentificationError : where shapes differ from one another or from the robot, a number is not finite, the rate is not
        above 0, or a column has another name; for a known torque of a robot without drive gains.
    AcquisitionError : for a velocity of another unit or sign.
    """
    for name in columns:
        if name not in OPTIONAL:
            raise IdentificationError(place=NAME, key=name, expected=f"columns {', '.join(OPTIONAL)}")
    if not 0 < sample_rate_hz < math.inf:
        raise IdentificationError(place=NAME, key="sample_rate_hz", value=sample_rate_hz, expected="a number above 0")
    arrays = {"q": _copied("q", q, robot.n), "effort": _copied("effort", effort, robot.n)}
    given = {
        "q_ref": q_ref,
        "velocity": columns.get("velocity"),
        "known_torque": columns.get("known_torque"),
        "feedforward": columns.get("feedforward"),
    }
    arrays |= {name: _copied(name, array, robot.n) for name, array in given.items() if array is not None}
    for name, array in arrays.items():
        if array.shape != arrays["q"].shape:
            expected = f"{arrays['q'].shape}, as q has"
            raise IdentificationError(place=NAME, key=f"{name}.shape", value=array.shape, expected=expected)
    digest = hashlib.sha256()
    for name, array in arrays.items():
        digest.update((name if name in OPTIONAL else "").encode() + array.tobytes())
    signals = Signals(
        t_s=np.arange(len(arrays["q"])) / sample_rate_hz,
        q=arrays["q"],
        q_ref=arrays.get("q_ref"),
        effort=arrays["effort"],
        sample_rate_hz=float(sample_rate_hz),
        track=None,
        robot=robot,
        recording=NAME,
        sha256=digest.hexdigest(),
        velocity=arrays.get("velocity"),
        known_torque=arrays.get("known_torque"),
        feedforward=arrays.get("feedforward"),
    )
    if signals.velocity is None:
        return signals
    doubts = check_recorded_velocities(robot, signals.q, signals.velocity, signals.sample_rate_hz, NAME)
    events = tuple(SignalEvent(t_s=float(signals.t_s[-1]), kind="warning", text=text) for text in doubts)
    return replace(signals, events=events)


def _copied(name: str, array: ArrayLike, n: int) -> Array:
    try:
        copied = np.array(array, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise IdentificationError(str(error), place=NAME, key=name, expected=f"numbers of shape (N, {n})") from error
    if copied.ndim != 2 or copied.shape[1] != n or len(copied) < 2:
        raise IdentificationError(place=NAME, key=f"{name}.shape", value=copied.shape, expected=f"(N, {n}), time first")
    return copied
