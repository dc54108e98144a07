"""Arrays in memory → `Signals`."""

import hashlib
import math

import numpy as np
from numpy.typing import ArrayLike

from acquisition.robot import Robot

from ..arrays import Array
from ..errors import IdentificationError
from .signals import Signals

NAME = "arrays"  # stands where the name of a recording stands


def signals_from_arrays(
    q: ArrayLike, effort: ArrayLike, sample_rate_hz: float, robot: Robot, q_ref: ArrayLike | None = None
) -> Signals:
    """Signals out of arrays that are copied.

    Parameters
    ----------
    q, q_ref : (N, n) measured and reference positions of the joints, rad or m.
    effort : (N, n) torques at the joint in N m, forces in N; in A or V where `robot` has no drive gain.
    sample_rate_hz : rate of the N samples.
    robot : its description, of n joints.

    Raises
    ------
    IdentificationError : where shapes differ from one another or from the robot, a number is not finite, the rate is not
        above 0.
    """
    if not 0 < sample_rate_hz < math.inf:
        raise IdentificationError(place=NAME, key="sample_rate_hz", value=sample_rate_hz, expected="a number above 0")
    given = {"q": q, "effort": effort, **({} if q_ref is None else {"q_ref": q_ref})}
    arrays = {name: _copied(name, array, robot.n) for name, array in given.items()}
    for name, array in arrays.items():
        if array.shape != arrays["q"].shape:
            raise IdentificationError(
                place=NAME, key=f"{name}.shape", value=array.shape, expected=f"{arrays['q'].shape}, as q has"
            )
    digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays.values()))
    return Signals(
        t_s=np.arange(len(arrays["q"])) / sample_rate_hz,
        q=arrays["q"],
        q_ref=arrays.get("q_ref"),
        effort=arrays["effort"],
        sample_rate_hz=float(sample_rate_hz),
        track=None,
        robot=robot,
        recording=NAME,
        sha256=digest.hexdigest(),
    )


def _copied(name: str, array: ArrayLike, n: int) -> Array:
    try:
        copied = np.array(array, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise IdentificationError(str(error), place=NAME, key=name, expected=f"numbers of shape (N, {n})") from error
    if copied.ndim != 2 or copied.shape[1] != n or len(copied) < 2:
        raise IdentificationError(place=NAME, key=f"{name}.shape", value=copied.shape, expected=f"(N, {n}), time first")
    return copied
