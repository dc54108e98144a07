"""Reference trajectories that excite a robot: periodic Fourier series that begin and end at rest."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import AcquisitionError
from .robot import Robot

Vector = NDArray[np.float64]

HARMONICS = 5
LIMIT_SHARE = 0.8  # of a joint's stated range and speed
UNSTATED_RANGE = 1.0  # rad or m to each side where a joint states no range


@dataclass(frozen=True, kw_only=True, eq=False)
class FourierReference:
    """q_j(t) = center_j + sum_k sine_jk sin(k w t) + cosine_jk (cos(k w t) - 1), w = 2 pi / period_s.

    `sine` and `cosine` are (n, H), rad or m. The coefficients make speed and acceleration zero at t = 0.
    """

    period_s: float
    center: Vector
    sine: Vector
    cosine: Vector

    def at(self, t_s: Vector) -> tuple[Vector, Vector, Vector]:
        """Position, speed and acceleration, each (N, n), at the times t_s (N,)."""
        k = np.arange(1, self.sine.shape[1] + 1) * 2 * np.pi / self.period_s
        phase = np.outer(t_s, k)
        sin, cos = np.sin(phase), np.cos(phase)
        q = self.center + sin @ self.sine.T + (cos - 1.0) @ self.cosine.T
        dq = (cos * k) @ self.sine.T - (sin * k) @ self.cosine.T
        ddq = -(sin * k**2) @ self.sine.T - (cos * k**2) @ self.cosine.T
        return q, dq, ddq


def fourier_reference(robot: Robot, *, period_s: float, seed: int) -> FourierReference:
    """A random series of five harmonics, scaled into 0.8 of each joint's stated range, speed and acceleration.

    Raises `AcquisitionError` when the period is not positive.
    """
    if not period_s > 0:
        raise AcquisitionError(f"period {period_s:g} s: expected more than 0")
    rng = np.random.default_rng(seed)
    k = np.arange(1, HARMONICS + 1)
    sine, cosine = rng.standard_normal((2, robot.n, HARMONICS)) / k
    # At t = 0 speed is sum k sine, acceleration sum k² cosine: take those parts out.
    sine -= (sine @ k)[:, None] * k / (k @ k)
    cosine -= (cosine @ k**2)[:, None] * k**2 / (k**2 @ k**2)
    raw = FourierReference(period_s=period_s, center=np.zeros(robot.n), sine=sine, cosine=cosine)
    q, dq, ddq = raw.at(np.linspace(0.0, period_s, 2000))
    middle, scale = np.empty(robot.n), np.empty(robot.n)
    for j, joint in enumerate(robot.joints):
        low, high = joint.si("position") or (-UNSTATED_RANGE, UNSTATED_RANGE)
        middle[j] = (low + high) / 2
        scale[j] = (high - low) / np.ptp(q[:, j])
        for limit, peak in ((joint.si("speed"), dq), (joint.si("acceleration"), ddq)):
            if limit is not None:
                scale[j] = min(scale[j], limit / np.abs(peak[:, j]).max())
    scale *= LIMIT_SHARE
    center = middle - scale * (q.max(axis=0) + q.min(axis=0)) / 2
    return FourierReference(
        period_s=period_s, center=center, sine=sine * scale[:, None], cosine=cosine * scale[:, None]
    )
