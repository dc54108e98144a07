"""Motions as Fourier series from rest to rest, and their limits.

Limits are of position, speed, acceleration and effort.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from acquisition.errors import Location
from acquisition.robot import EffortLimits, FourierReference, Robot, effort_limits

from ..arrays import Array, Ints
from ..model import DirectModel, torque_of_links, torque_without_sliding

KINDS = ("position", "speed", "acceleration")

Motion = tuple[Array, Array, Array]
"""Position, speed and acceleration, each (N, n), in rad or m; of a basis (N, K)."""


@dataclass(frozen=True, kw_only=True)
class Series:
    """Fourier series whose speed and acceleration are zero at the ends of the period.

    The series of a joint has K = 2 H - 1 coefficients: its position at the ends, and coordinates in
    the null spaces of both conditions. The coefficients of n joints are x, shape (n, K).

    Attributes:
        period_s: period, s.
        harmonics: number H of harmonics.
    """

    period_s: float
    harmonics: int

    @cached_property
    def _null_spaces(self) -> tuple[Array, Array]:
        """Bases of sine coefficients without speed and cosine coefficients without acceleration.

        Both conditions hold at the ends of the period; each basis has the shape (H, H - 1).
        """
        k = np.arange(1, self.harmonics + 1, dtype=float)
        # With coefficients s/k, harmonics of equal s have equal speeds. At the ends the speed is
        # then sum(s) and the acceleration sum(k s), so a basis has columns orthogonal to v.
        sine, cosine = (
            np.linalg.qr(v[:, None], mode="complete")[0][:, 1:] / k[:, None]
            for v in (np.ones_like(k), k)
        )
        return sine, cosine

    def reference(self, x: Array) -> FourierReference:
        """Return the series of the coefficients x, shape (n, K)."""
        sine, cosine = self._null_spaces
        return FourierReference(
            period_s=self.period_s,
            center=x[:, 0],
            sine=x[:, 1 : self.harmonics] @ sine.T,
            cosine=x[:, self.harmonics :] @ cosine.T,
        )

    def coefficients(self, reference: FourierReference) -> Array:
        """Return the coefficients of a reference that is such a series, shape (n, K)."""
        sine, cosine = (np.linalg.pinv(basis) for basis in self._null_spaces)
        return np.concatenate(
            [reference.center[:, None], reference.sine @ sine.T, reference.cosine @ cosine.T],
            axis=1,
        )

    def basis(self, samples: int) -> Motion:
        """Return the basis of the series at equidistant samples of one period.

            q_j = A x_j

        Parameters
        ----------
        samples : number N of samples.

        Returns
        -------
        The matrices A of positions, speeds and accelerations, shape (N, K) each.
        """
        return self.reference(np.eye(2 * self.harmonics - 1)).at(
            np.arange(samples, dtype=np.float64) * (self.period_s / samples)
        )


def motion_of(x: Array, basis: Motion) -> Motion:
    """Return the motion of a series.

    Parameters
    ----------
    x : coefficients, shape (n, K).
    basis : basis of the series at N samples, shape (N, K) each.

    Returns
    -------
    Positions, speeds and accelerations, shape (N, n) each.
    """
    return basis[0] @ x.T, basis[1] @ x.T, basis[2] @ x.T


@dataclass(frozen=True, kw_only=True, eq=False)
class Limits:
    """Limits of the motion of a robot. A share of 1 or -1 is the whole usable part of a limit.

    Friction that has the sign of a speed, load-dependent friction included, counts at its full size
    against the motion. This is valid for both signs of the speed, and has no steps.

    Attributes:
        robot: the robot.
        middle: middle of the position ranges, shape (n,).
        maximum: half the position range, the speed and the acceleration, each times `share`, shape
            (3, n).
        models: direct models for the torque, one per load of the robot; empty if the parameters are
            unknown.
        effort: limits of the efforts.
        coulomb: largest part of each effort that friction with the sign of a speed takes, shape
            (m,): Coulomb, Stribeck and square-root friction.
        share: usable share of all limits.
    """

    robot: Robot
    middle: Array
    maximum: Array
    models: tuple[DirectModel, ...]
    effort: EffortLimits
    coulomb: Array
    share: float

    @property
    def model(self) -> DirectModel | None:
        """Direct model without a payload; None if the parameters are unknown."""
        return next(iter(self.models), None)

    @property
    def allowed(self) -> Array:
        """Usable effort limits minus `coulomb`, shape (m,)."""
        return self.share * self.effort.limits - self.coulomb

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the limited quantities, shape (L,).

        The order is: positions, speeds and accelerations of all joints, then the efforts for each
        load.
        """
        return (
            *(f"{kind} of joint {joint.name}" for kind in KINDS for joint in self.robot.joints),
            *(
                f"effort of {name}{load}"
                for load in ("", " with the payload")[: len(self.models)]
                for name in self.effort.names
            ),
        )

    def largest(self, motion: Motion) -> tuple[float, str]:
        """Return the largest share of any limit that a motion uses, and the name of this limit."""
        used = np.abs(self.shares(motion)).max(axis=0)
        return float(used.max()), self.names[int(used.argmax())]

    def share_of_whole(self, motion: Motion) -> Array:
        """Return the largest share that a motion uses of each whole limit, shape (L,).

        It includes the friction of `coulomb`.
        """
        n, used = self.robot.n, np.abs(self.shares(motion)).max(axis=0)
        by_load = used[3 * n :].reshape(len(self.models), len(self.effort.limits))
        efforts = (by_load * self.allowed + self.coulomb) / self.effort.limits
        return np.concatenate([self.share * used[: 3 * n], efforts.ravel()])

    def shares_and_slopes(self, motion: Motion) -> tuple[Array, Array]:
        """Return the shares of all limits and the derivatives of those of efforts.

        Parameters
        ----------
        motion : positions, speeds and accelerations, shape (N, n) each.

        Returns
        -------
        The shares, shape (N, L), and the derivatives of the m shares of efforts by positions,
        speeds and accelerations, shape (3, N, m, n).
        """
        scaled = self.effort.directions / self.allowed[:, None]
        slopes = [np.zeros((3, len(motion[0]), 0, self.robot.n))]
        for model in self.models:
            links = torque_of_links(model, motion)
            tau, by_joint = torque_without_sliding(model, motion, links)
            by_load = (np.abs(model.load_friction) * np.sign(links[0]))[..., None] * links[1]
            slopes.append(
                scaled @ by_joint + _sides(tau @ scaled.T)[..., None] * (np.abs(scaled) @ by_load)
            )
        return self.shares(motion), np.concatenate(slopes, axis=2)

    def shares(self, motion: Motion) -> Array:
        """Return the signed shares of all limits along a motion, shape (N, L).

        Parameters
        ----------
        motion : positions, speeds and accelerations, shape (N, n) each.
        """
        q, dq, ddq = motion
        parts = [(q - self.middle) / self.maximum[0], dq / self.maximum[1], ddq / self.maximum[2]]
        scaled = self.effort.directions / self.allowed[:, None]
        for model in self.models:
            rigid = model.torques_of_links(*motion)
            shares = (rigid + model.without_sliding(dq, ddq)) @ scaled.T
            by_load = np.abs(model.load_friction) * np.abs(rigid)
            parts.append(shares + _sides(shares) * (by_load @ np.abs(scaled).T))
        return np.concatenate(parts, axis=1)

    def jacobian(self, slopes: Array, basis: Motion, at: Ints) -> Array:
        """Return the derivatives of shares by the coefficients of a series.

        Parameters
        ----------
        slopes : derivatives of the shares of efforts, shape (3, N, m, n).
        basis : basis of the series, shape (N, K) each.
        at : samples of the shares, shape (B, L).

        Returns
        -------
        The derivatives, shape (B L, n K).
        """
        n, K = self.robot.n, basis[0].shape[1]
        efforts, J = at[:, 3 * n :], np.zeros((*at.shape, n, K))
        for kind, A in enumerate(basis):
            for j in range(n):
                J[:, kind * n + j, j] = A[at[:, kind * n + j]] / self.maximum[kind, j]
            by_joint = slopes[kind][efforts, np.arange(efforts.shape[1])]  # (B, m, n)
            J[:, 3 * n :] += by_joint[..., None] * A[efforts][:, :, None]
        return J.reshape(at.size, n * K)


def _sides(shares: Array) -> Array:
    """Return the sign, 1 or -1, with which load-dependent friction enlarges the shares."""
    return np.where(shares < 0, -1.0, 1.0)


def limits_of(robot: Robot, models: Sequence[DirectModel], share: float, place: str) -> Limits:
    """Return the limits of a robot.

    Parameters
    ----------
    robot : the robot.
    models : direct models for the torque, one per load, with the same friction.
    share : share of each limit that a reference may use, greater than 0 and at most 1.
    place : name of the description in errors.

    Returns
    -------
    The limits.

    Raises
    ------
    BadInputError : a joint has no limit, or friction alone takes the usable effort of a joint or
        motor.
    """
    for (i, joint), (kind, tail) in product(
        enumerate(robot.joints), zip(KINDS, ("", "_s", "_s2"), strict=True)
    ):
        Location(place).require(
            joint.si(kind) is not None,
            f"joint[{i}].{kind}_{'deg' if joint.type == 'revolute' else 'm'}{tail}",
            text=f"joint {joint.name} has no {kind} limit",
            advice="Add this key to robot.toml",
        )
    ranges = np.array([joint.si("position") for joint in robot.joints])
    limits = effort_limits(robot)
    coulomb = np.zeros(len(limits.limits))
    # All loads have the same friction, so the first model is enough.
    for model in models[:1]:
        sliding = np.maximum(np.abs(model.up), np.abs(model.down)) + model.largest_shape(
            np.abs(model.directions) @ np.array([joint.si("speed") for joint in robot.joints])
        )
        coulomb = np.abs(limits.directions @ model.directions.T) @ sliding
    for name, unit, friction, limit in zip(
        limits.names, limits.units, coulomb, limits.limits, strict=True
    ):
        Location(place).require(
            friction < share * limit,
            text=f"Coulomb friction of {name} is {friction:.4g} {unit}, at least "
            f"{100 * share:g} % of its effort limit of {limit:.4g} {unit}",
            advice="Check the effort limit and the friction parameters",
        )
    return Limits(
        robot=robot,
        middle=ranges.mean(axis=1),
        maximum=share
        * np.array(
            [
                np.ptp(ranges, axis=1) / 2,
                *([joint.si(kind) for joint in robot.joints] for kind in KINDS[1:]),
            ]
        ),
        models=tuple(models),
        effort=limits,
        coulomb=coulomb,
        share=share,
    )
