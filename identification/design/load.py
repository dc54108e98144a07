"""Load friction in the criterion: its columns about given parameters, as a fit has them (`regression.load`), and gradients.

In the rows of joint j, with r = tau_rigid of the given parameters, mu its load friction, and D = mu s W of the links,

    W = [links: W + D, mu: size sign],    size = abs(r), s = sign(r) sign(dq), sign = sign(dq).

A jump has no gradient: in the criterion sign(dq) is u / sqrt(1 + u²), u = dq / creep, and abs(r) is sqrt(r² + least²), whose
derivative stands for sign(r).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..model import DirectModel, torque_of_links
from ..regression import LoadFriction
from .series import Motion

LEAST_SHARE = 0.05  # of a joint's rms torque of the links: about it abs(tau_rigid) is rounded


@dataclass(frozen=True, kw_only=True, eq=False)
class GivenLoad:
    """Load friction of joints (k,) with the torque of the links of given parameters.

    Attributes:
        friction: which joints have it, and where their mu is among the base parameters.
        model: the equation of motion with the parameters.
        beta: (b,) the parameters.
        least: (k,) torque or force below which the size of the links' torque is rounded in the criterion.
        creep: (k,) speeds below which the sign of the speed is rounded.
    """

    friction: LoadFriction
    model: DirectModel
    beta: Array
    least: Array
    creep: Array

    def exact(self, W: Array, motion: Motion) -> None:
        """Fill W (N, n, b), whose load columns are zero, with those along a motion; in place."""
        joints = self.friction.joints
        rigid = self.model.torques_of_links(*motion)[:, joints].T
        sign = np.sign(motion[1][:, joints].T)
        self._fill(W, np.abs(rigid) * sign, np.sign(rigid) * sign)

    def smooth(self, W: Array, motion: Motion) -> "SmoothLoad":
        """Fill W with rounded columns; what is returned has their part of gradients."""
        joints = self.friction.joints
        rigid, by_joint = torque_of_links(self.model, motion)
        slip = motion[1][:, joints].T / self.creep[:, None]
        root = np.sqrt(1 + slip**2)
        size = np.sqrt(rigid[:, joints].T ** 2 + self.least[:, None] ** 2)
        found = SmoothLoad(
            given=self,
            of_links=W[:, joints][..., self.friction.links].transpose(1, 0, 2).copy(),
            size=size,
            side=rigid[:, joints].T / size,
            sign=slip / root,
            sign_by_speed=root**-3 / self.creep[:, None],
            rigid_slopes=by_joint[:, :, joints],
        )
        self._fill(W, size * found.sign, found.side * found.sign)
        return found

    def _fill(self, W: Array, columns: Array, s: Array) -> None:
        self.friction.linearise(W.transpose(1, 2, 0), None, np.stack([columns, s]), self.beta)


def given_load(
    friction: LoadFriction, model: DirectModel | None, beta: Array | None, motions: Sequence[Motion], creep: Array
) -> GivenLoad | None:
    """Load friction with the torque of the links of given parameters (b,); None where there is none, or no parameters.

    The size of the links' torque is usual along `motions`; below the speeds `creep` (n,) the sign of a speed is rounded.
    """
    if model is None or beta is None or not friction:
        return None
    rigid = np.concatenate([model.torques_of_links(*motion) for motion in motions])[:, friction.joints]
    rms = np.sqrt(np.mean(rigid**2, axis=0))
    least = LEAST_SHARE * np.maximum(rms, 1e-6 * rms.max())
    return GivenLoad(friction=friction, model=model, beta=beta, least=least, creep=creep[friction.joints])


@dataclass(frozen=True, kw_only=True, eq=False)
class SmoothLoad:
    """Rounded columns of load friction along a motion.

    Attributes:
        given: what they are of.
        of_links: (k, N, links) the links' part of the rows before load friction.
        size, side, sign, sign_by_speed: (k, N) sqrt(r² + least²), its derivative by r, the rounded sign of the speed, its
            derivative by the speed.
        rigid_slopes: (3, N, k, n) derivatives of r by q, dq and ddq.
    """

    given: GivenLoad
    of_links: Array
    size: Array
    side: Array
    sign: Array
    sign_by_speed: Array
    rigid_slopes: Array

    def gradient(self, G: Array) -> tuple[Array, Array]:
        """From df/dW (N, n, b): df by the linear model's W (N, n, b), and the rest's gradients (3, N, n) by the motion."""
        friction, G_linear = self.given.friction, G.copy()
        rest = np.zeros((3, len(G), G.shape[1]))
        for i, (j, place) in enumerate(zip(friction.joints, friction.places, strict=True)):
            mu, size, side, sign = self.given.beta[place], self.size[i], self.side[i], self.sign[i]
            G_linear[:, j, friction.links] *= 1 + (mu * side * sign)[:, None]
            G_linear[:, j, place] = 0.0
            by_s = mu * (G[:, j, friction.links] * self.of_links[i]).sum(axis=1)
            by_mu = G[:, j, place]
            bend = self.given.least[i] ** 2 / size**3  # derivative of `side` by r
            by_rigid = (by_s * bend + by_mu * side) * sign
            rest += by_rigid[:, None] * self.rigid_slopes[:, :, i]
            rest[1, :, j] += (by_s * side + by_mu * size) * self.sign_by_speed[i]
        return G_linear, rest
