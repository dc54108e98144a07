"""Motions as Fourier series from rest to rest, and their limits: position,
speed, acceleration, effort.
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
    """Periodic Fourier series whose speed and acceleration are zero at the ends of the period.

    A joint's series has K = 2 H - 1 coefficients: its position at the ends, and those in a basis of
    the null space of both conditions. A motion of n joints is x (n, K).
    """

    period_s: float
    harmonics: int

    @cached_property
    def _null_spaces(self) -> tuple[Array, Array]:
        """Null spaces, (H, H - 1) each: sine coefficients with zero speed, cosine coefficients with
        zero acceleration at the ends.
        """
        k = np.arange(1, self.harmonics + 1, dtype=float)
        # With coefficients s/k, harmonics of equal s have equal speeds: the speed is sum(s), the
        # acceleration sum(k s). The columns of a basis are orthogonal to v.
        sine, cosine = (
            np.linalg.qr(v[:, None], mode="complete")[0][:, 1:] / k[:, None]
            for v in (np.ones_like(k), k)
        )
        return sine, cosine

    def reference(self, x: Array) -> FourierReference:
        """Return the series with the coefficients x (n, K)."""
        sine, cosine = self._null_spaces
        return FourierReference(
            period_s=self.period_s,
            center=x[:, 0],
            sine=x[:, 1 : self.harmonics] @ sine.T,
            cosine=x[:, self.harmonics :] @ cosine.T,
        )

    def coefficients(self, reference: FourierReference) -> Array:
        """Return x (n, K) of a reference that is such a series."""
        sine, cosine = (np.linalg.pinv(basis) for basis in self._null_spaces)
        return np.concatenate(
            [reference.center[:, None], reference.sine @ sine.T, reference.cosine @ cosine.T],
            axis=1,
        )

    def basis(self, samples: int) -> Motion:
        """Return matrices (N, K) of position, speed and acceleration at N instants from the start
        of a period.

            q_j = A x_j
        """
        return self.reference(np.eye(2 * self.harmonics - 1)).at(
            np.arange(samples, dtype=np.float64) * (self.period_s / samples)
        )


def motion_of(x: Array, basis: Motion) -> Motion:
    """Return q, dq, ddq (N, n) of the coefficients x (n, K)."""
    return basis[0] @ x.T, basis[1] @ x.T, basis[2] @ x.T


@dataclass(frozen=True, kw_only=True, eq=False)
class Limits:
    """Limits of a robot's motion; a share of 1 or -1 is all that may be used of a limit.

    Friction with the sign of a speed (load-dependent friction too) counts at full size against the
    motion: valid for both signs of a speed, without jumps.

    Attributes:
        middle: (n,) of the joints' ranges.
        maximum: (3, n) half the range, the speed, the acceleration, each times the share that may
            be
            used.
        models: with the parameters for the torque, one for each load that the robot carries; empty
            if
            unknown.
        coulomb: (m,) most that signed friction takes of each effort: Coulomb, Stribeck, root of
            speed.
        share: that may be used of all limits.
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
        """Model of the robot without load; None if its parameters are unknown."""
        return next(iter(self.models), None)

    @property
    def allowed(self) -> Array:
        """Effort limits less Coulomb friction, (m,)."""
        return self.share * self.effort.limits - self.coulomb

    @property
    def names(self) -> tuple[str, ...]:
        """The limited quantities, (L,): position, speed and acceleration of each joint, efforts by
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
        """Return the largest share used of a limit, and its name."""
        used = np.abs(self.shares(motion)).max(axis=0)
        return float(used.max()), self.names[int(used.argmax())]

    def share_of_whole(self, motion: Motion) -> Array:
        """Return the largest share (L,) that a motion uses of each whole limit, with Coulomb
        friction.
        """
        n, used = self.robot.n, np.abs(self.shares(motion)).max(axis=0)
        by_load = used[3 * n :].reshape(len(self.models), len(self.effort.limits))
        efforts = (by_load * self.allowed + self.coulomb) / self.effort.limits
        return np.concatenate([self.share * used[: 3 * n], efforts.ravel()])

    def shares_and_slopes(self, motion: Motion) -> tuple[Array, Array]:
        """Return the shares (N, L), and derivatives (3, N, m, n) of the m shares of efforts by q,
        dq and ddq.
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
        """Return shares (N, L), signed, along a motion q, dq, ddq (N, n)."""
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
        """Return derivatives (B L, n K) of shares at samples `at` (B, L) by a series' coefficients,
        of its basis and their slopes.
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
    """Return the sign, 1 or -1, of load-dependent friction that enlarges the shares of efforts."""
    return np.where(shares < 0, -1.0, 1.0)


def limits_of(robot: Robot, models: Sequence[DirectModel], share: float, place: str) -> Limits:
    """Return the limits of a robot, of which a reference may use a `share` in (0, 1].

    The torque is limited by each of the `models`, with the same friction. `place` names the
    description in errors.

    Raises
    ------
    BadInputError : a joint has no limit, or friction alone needs more than a joint's or motor's
        effort.
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
