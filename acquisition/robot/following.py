"""Follows a path, one row each SYNC; after a stop request it slows down along the path to rest."""

from collections.abc import Callable, Iterator

import numpy as np

from ..arrays import Array
from .robot import Robot

SLOW_STOP_S = 0.5  # from a stop request to rest; longer where acceleration limits need it


def follow(path: Array, robot: Robot, period_s: float, stopping: Callable[[], bool]) -> Iterator[Array]:
    """Joint positions (n,) along a path (N, n), one for each SYNC; once `stopping()` is true, the motion slows down to rest.

    It slows down along the path, by at most half of the joints' acceleration limits in addition to the path's own acceleration.
    """
    at, rate = 0.0, 1.0
    speed = np.abs(np.diff(path, axis=0)).max(axis=0, initial=0.0) / period_s
    stop_s = max(SLOW_STOP_S, *(2 * v / j.si("acceleration") for v, j in zip(speed, robot.joints, strict=True)))
    while at < len(path) - 1 and rate > 0.0:
        yield _between(path, at)
        if stopping():
            rate = max(0.0, rate - period_s / stop_s)
        at = min(at + rate, len(path) - 1.0)
    yield _between(path, at)


def _between(path: Array, at: float) -> Array:
    """Row of a path at a fractional index, by linear interpolation."""
    k = min(int(at), len(path) - 2) if len(path) > 1 else 0
    then = path[min(k + 1, len(path) - 1)]
    q: Array = path[k] + (at - k) * (then - path[k])
    return q
