"""Reference trajectories: periodic Fourier series, tables, moves to a point; checks of limits.

All begin and end at rest.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..arrays import Array, first_true
from ..errors import Location
from ..files import read_columns
from .robot import Robot

HARMONICS = 5
# Time from a stop request to rest; acceleration limits may lengthen it.
SLOW_STOP_S = 0.5
LIMIT_SHARE = 0.8  # of a joint's range and speed limit


@dataclass(frozen=True, kw_only=True, eq=False)
class FourierReference:
    """A Fourier series for each joint.

        q_j(t) = center_j + sum_k sine_jk sin(k w t) + cosine_jk (cos(k w t) - 1),
        w = 2 pi / period_s

    The coefficients make speed and acceleration zero at t = 0.

    Attributes:
        period_s: period in s.
        center: (n,) positions at t = 0, rad or m.
        sine: (n, H) coefficients, rad or m.
        cosine: (n, H) coefficients, rad or m.
    """

    period_s: float
    center: Array
    sine: Array
    cosine: Array

    def at(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Compute position, speed and acceleration, each (N, n), at the times t_s (N,)."""
        k = np.arange(1, self.sine.shape[1] + 1) * 2 * np.pi / self.period_s
        phase = np.outer(t_s, k)
        sin, cos = np.sin(phase), np.cos(phase)
        return (
            self.center + sin @ self.sine.T + (cos - 1.0) @ self.cosine.T,
            (cos * k) @ self.sine.T - (sin * k) @ self.cosine.T,
            -(sin * k**2) @ self.sine.T - (cos * k**2) @ self.cosine.T,
        )


def fourier_reference(
    robot: Robot,
    *,
    period_s: float,
    seed: int,
    harmonics: int = HARMONICS,
    share: float = LIMIT_SHARE,
) -> FourierReference:
    """Draw a random Fourier series for each joint, from rest to rest.

    Parameters
    ----------
    robot : the robot; each joint needs a position range.
    period_s : period in s.
    seed : seed; the same one gives the same series.
    harmonics : number of harmonics, at least 2.
    share : share of each joint's range, speed and acceleration limit that is used.

    Raises
    ------
    BadInputError : the period is not positive, or a joint has no range.
    """
    Location("").require(period_s > 0, "period_s", period_s, "greater than 0")
    for i, joint in enumerate(robot.joints):
        Location(f"robot {robot.name}: joint {joint.name}", f"joint[{i}]").require(
            joint.si("position") is not None,
            joint.key("position"),
            None,
            advice="Give [lowest, highest], within which the reference moves",
        )
    k = np.arange(1, harmonics + 1)
    sine, cosine = np.random.default_rng(seed).standard_normal((2, robot.n, harmonics)) / k
    # At t = 0 the speed is sum k sine, the acceleration sum k² cosine: subtract these parts.
    sine -= (sine @ k)[:, None] * k / (k @ k)
    cosine -= (cosine @ k**2)[:, None] * k**2 / (k**2 @ k**2)
    q, dq, ddq = FourierReference(
        period_s=period_s, center=np.zeros(robot.n), sine=sine, cosine=cosine
    ).at(np.linspace(0.0, period_s, 2000))
    low, high = np.array([joint.si("position") for joint in robot.joints]).T
    scale = (high - low) / np.ptp(q, axis=0)
    for quantity, peak in (("speed", dq), ("acceleration", ddq)):
        scale = np.minimum(
            scale,
            [joint.si(quantity) or np.inf for joint in robot.joints] / np.abs(peak).max(axis=0),
        )
    scale *= share
    center = (low + high) / 2 - scale * (q.max(axis=0) + q.min(axis=0)) / 2
    sine, cosine = (x * scale[:, None] for x in (sine, cosine))
    return FourierReference(period_s=period_s, center=center, sine=sine, cosine=cosine)


APPROACH_SHARE = 0.1  # of each joint's speed and acceleration limit
MAX_ROUNDING = 1e-9  # relative; by this a reference may exceed a limit
MAX_TABLE_S = 24 * 3600.0  # duration of a table
# A path has a position of each joint at each SYNC: so many numbers take 0.8 GB.
MAX_PATH_VALUES = 10**8


def table_reference(path: Path, robot: Robot, period_s: float, speed: float = 1.0) -> Array:
    """Read joint positions (N, n) along a table, one row per SYNC.

    Cubic splines interpolate between the rows of the table.

    Parameters
    ----------
    path : CSV file with `time_s`, then each joint by name, in rad or m.
    robot : the robot.
    period_s : SYNC period in s.
    speed : factor in (0, 1] of all speeds; its square applies to accelerations.

    Raises
    ------
    BadInputError : the table cannot be read, its time does not grow, it lasts longer than a day or
        than memory allows, or no spline leads through its numbers.
    """
    from scipy.interpolate import CubicSpline

    table = read_columns(path, ["time_s", *(joint.name for joint in robot.joints)], 1 + robot.n)
    time_s, at = table[:, 0], Location(f"{path}: time_s")
    # Overflows are refused below, so they need no warning of numpy.
    with np.errstate(all="ignore"):
        at.require(
            len(table) >= 2 and (np.diff(time_s) > 0).all(),
            text="the table has fewer than 2 rows, or times that do not grow",
        )
        length_s = float(time_s[-1] - time_s[0]) / speed
        longest_s = min(MAX_TABLE_S, MAX_PATH_VALUES / robot.n * period_s)
        slower = f" at {speed:g} times its speed" if speed != 1 else ""
        at.require(
            length_s <= longest_s,
            text=f"the path takes {length_s:.6g} s{slower}",
            expected=f"at most {longest_s:.6g} s, with SYNC every {period_s:g} s",
        )
        times = time_s[0] + np.arange(int(length_s / period_s + 1e-6) + 1) * (period_s * speed)
        try:
            q: Array = CubicSpline(time_s, table[:, 1:], bc_type="clamped")(times)
        # The equations overflow if rows are too close or numbers too large.
        except ValueError:
            q = np.array([np.nan])
    if not np.isfinite(q).all():
        Location(str(path)).refuse(
            text=f"no smooth path leads through rows {np.diff(time_s).min():.3g} s apart with "
            f"positions of up to {np.abs(table[:, 1:]).max():.3g}",
            advice="Give times in s and positions in rad or m",
        )
    return q


def missing_limits(robot: Robot) -> list[str]:
    """List the limits that motion needs and the description does not give, in words."""
    return [
        f"joint[{i}] ({joint.name}) has no {quantity.replace('_', ' ')} limit"
        for i, joint in enumerate(robot.joints)
        for quantity in ("position", "speed", "acceleration", "following_error")
        if joint.si(quantity) is None
    ]


def check_limits(q: Array, robot: Robot, period_s: float, place: str) -> None:
    """Refuse a path (N, n) from rest to rest, rad or m, that exceeds limits.

    The limits are those of position, speed and acceleration. A path is also refused if limits are
    missing.
    """
    for problem in missing_limits(robot):
        Location(place).refuse(text=problem, advice="Add it to robot.toml before motion")
    # Values that are not finite are refused below.
    with np.errstate(over="ignore", invalid="ignore"):
        dq = np.diff(q, axis=0, prepend=q[:1], append=q[-1:]) / period_s
        ddq = np.diff(dq, axis=0) / period_s
    for i, joint in enumerate(robot.joints):
        speed, acceleration = joint.si("speed"), joint.si("acceleration")
        for name, values, bottom, top, per in (
            ("position", q[:, i], *joint.si("position"), ""),
            ("speed", dq[:, i], -speed, speed, "/s"),
            ("acceleration", ddq[:, i], -acceleration, acceleration, "/s²"),
        ):
            slack = MAX_ROUNDING * max(abs(bottom), abs(top))
            # NaN fails both comparisons, so it is outside.
            inside = (values >= bottom - slack) & (values <= top + slack)
            if (k := first_true(~inside)) is not None:
                Location(f"{place}: at {k * period_s:.4g} s").refuse(
                    f"{name} of {joint.name}",
                    float(values[k]),
                    f"{bottom:.4g} to {top:.4g}",
                    shown=f"{values[k]:.4g} {joint.position_unit}{per}",
                )


def approach(start: Array, end: Array, robot: Robot, period_s: float) -> Array:
    """Compute a slow straight move (N, n) of minimum jerk.

    It leads from rest at `start` to rest at `end` (n,). Obstacles are not checked.
    """
    distance = np.abs(end - start)
    speed, acceleration = (
        np.array([joint.si(quantity) for joint in robot.joints]) * APPROACH_SHARE
        for quantity in ("speed", "acceleration")
    )
    # The largest speed and acceleration of 10 x³ - 15 x⁴ + 6 x⁵ over one second are 1.875 and
    # 5.774.
    duration_s = float(
        np.maximum(1.875 * distance / speed, np.sqrt(5.774 * distance / acceleration)).max(
            initial=0.2
        )
    )
    x = np.linspace(0.0, 1.0, int(np.ceil(duration_s / period_s)) + 1)[:, None]
    return np.asarray(start + (end - start) * (10 * x**3 - 15 * x**4 + 6 * x**5))


def follow(
    path: Array, robot: Robot, period_s: float, stopping: Callable[[], bool]
) -> Iterator[Array]:
    """Yield joint positions (n,) along a path (N, n), one per SYNC.

    Once `stopping()` is true, the motion slows down along the path to rest. This adds at most half
    of the joints' acceleration limits to the path's own acceleration.
    """
    at, rate = 0.0, 1.0
    speed = np.abs(np.diff(path, axis=0)).max(axis=0, initial=0.0) / period_s
    stop_s = max(
        SLOW_STOP_S,
        *(2 * v / j.si("acceleration") for v, j in zip(speed, robot.joints, strict=True)),
    )
    while at < len(path) - 1 and rate > 0.0:
        yield _between(path, at)
        if stopping():
            rate = max(0.0, rate - period_s / stop_s)
        at = min(at + rate, len(path) - 1.0)
    yield _between(path, at)


def _between(path: Array, at: float) -> Array:
    """Interpolate a path linearly at a fractional index."""
    k = min(int(at), len(path) - 2) if len(path) > 1 else 0
    then = path[min(k + 1, len(path) - 1)]
    return np.asarray(path[k] + (at - k) * (then - path[k]))
