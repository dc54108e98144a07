"""Fourier series from rest to rest, linear in their free coefficients."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from acquisition.robot import FourierReference

from ..arrays import Array

Motion = tuple[Array, Array, Array]
"""Position, speed and acceleration, each (N, n), in rad or m; of a basis (N, K)."""


@dataclass(frozen=True, kw_only=True)
class Series:
    """Periodic Fourier series whose speed and acceleration are zero at the ends of the period.

    A joint's series has K = 2 H - 1 coefficients: its position at the ends, and those of a basis of the null space of the two
    conditions. A motion of n joints is x (n, K).
    """

    period_s: float
    harmonics: int

    @property
    def K(self) -> int:
        """Coefficients of a joint."""
        return 2 * self.harmonics - 1

    @cached_property
    def _null_spaces(self) -> tuple[Array, Array]:
        """(H, H - 1) each: sine coefficients with zero speed, cosine coefficients with zero acceleration at the ends."""
        k = np.arange(1, self.harmonics + 1, dtype=float)
        # With coefficients s/k, harmonics of equal s have equal speeds: the speed is sum(s), the acceleration sum(k s).
        return _complement(np.ones_like(k)) / k[:, None], _complement(k) / k[:, None]

    def reference(self, x: Array) -> FourierReference:
        """The series with the coefficients x (n, K)."""
        H = self.harmonics
        sine, cosine = self._null_spaces
        return FourierReference(
            period_s=self.period_s, center=x[:, 0], sine=x[:, 1:H] @ sine.T, cosine=x[:, H:] @ cosine.T
        )

    def coefficients(self, reference: FourierReference) -> Array:
        """x (n, K) of a reference that is such a series."""
        sine, cosine = (np.linalg.pinv(basis) for basis in self._null_spaces)
        return np.concatenate([reference.center[:, None], reference.sine @ sine.T, reference.cosine @ cosine.T], axis=1)

    def basis(self, samples: int) -> Motion:
        """Matrices (N, K) of position, speed and acceleration at N instants of a period, from its begin: q_j = A x_j."""
        t_s = np.arange(samples, dtype=np.float64) * (self.period_s / samples)
        position, speed, acceleration = self.reference(np.eye(self.K)).at(t_s)
        return position, speed, acceleration


def motion_of(x: Array, basis: Motion) -> Motion:
    """q, dq, ddq (N, n) of the coefficients x (n, K)."""
    q, dq, ddq = (A @ x.T for A in basis)
    return q, dq, ddq


def _complement(v: Array) -> Array:
    """Orthonormal basis (H, H - 1) of the vectors square to v (H,)."""
    return np.asarray(np.linalg.qr(v[:, None], mode="complete")[0][:, 1:])
