"""What a motion tells of the base parameters: the A-optimal criterion relative to a plain reference, and its gradient.

The information of a motion is M = sum of W'W / s², s the torque noise of each joint; the deviations of the parameters are
sigma = sqrt(diag(inv(M))). The criterion is log(mean((sigma / sigma of a plain reference)²)).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..arrays import Array
from ..errors import IdentificationError
from ..model import SLIDING, BaseParameters, InverseModel, JointTerm, regressor_gradient
from .series import Motion


@dataclass(frozen=True, kw_only=True, eq=False)
class Information:
    """Information of motions about the base parameters.

    Attributes:
        model, base: the inverse dynamic model, its base parameters.
        noise: (n,) deviation of each joint's torque in a row of the fit, in the unit of its effort.
        rows: of the fit in the whole recording, however many samples a motion is given by.
        earlier: (b, b) information of earlier recordings, which adds to that of the motion.
        creep: (n,) speeds at which friction changes its sign in the criterion, as u / sqrt(u² + creep²): a jump has no
            gradient, and a fit leaves out rows of low speed.
    """

    model: InverseModel
    base: BaseParameters
    noise: Array
    rows: float
    earlier: Array
    creep: Array

    def sigma(self, motion: Motion) -> Array:
        """(b,) deviations of the parameters after a motion q, dq, ddq (N, n)."""
        return np.asarray(np.sqrt(np.diag(_inverse(self._of(self._linear(motion))))))

    def criterion(self, motion: Motion, plain: Array) -> tuple[float, Motion]:
        """The criterion relative to the deviations `plain` (b,), and its gradients (N, n) by q, dq and ddq."""
        W = self._linear(motion)
        slopes = []
        for c, term in self._sliding:
            friction, slope = term.rounded(motion[1], self.creep)
            W[:, :, c] = friction[:, None] * term.direction
            slopes.append(slope)
        C, D = _inverse(self._of(W)), 1 / plain**2
        total = float(D @ np.diag(C))
        # total = tr(D C), so d total = -tr(P dM) with P = C D C, and dM = 2 W'dW / s².
        G = -2 / total * self.rows / len(W) * (W / self.noise[:, None] ** 2) @ ((C * D) @ C)
        by_q, by_dq, by_ddq = regressor_gradient(self.model, self.base, motion, G)
        for (c, term), slope in zip(self._sliding, slopes, strict=True):
            by_dq += (slope * (G[:, :, c] @ term.direction))[:, None] * term.direction
        return float(np.log(total / len(D))), (by_q, by_dq, by_ddq)

    def _linear(self, motion: Motion) -> Array:
        """W (N, n, b)."""
        entries = self.model.entries(self.base.columns)
        W = np.zeros((*motion[0].shape, self.base.b))
        W[:, entries[:, 0], entries[:, 1]] = self.model.series(*motion, self.base.columns).T
        return W

    def _of(self, W: Array) -> Array:
        V = (W / self.noise[:, None]).reshape(-1, W.shape[-1])
        return np.asarray(V.T @ V * (self.rows / len(W)) + self.earlier)

    @cached_property
    def _sliding(self) -> list[tuple[int, JointTerm]]:
        """Columns, and terms, of friction with the sign of a speed."""
        terms = [(c, self.model.sources[column]) for c, column in enumerate(self.base.columns)]
        return [(c, t) for c, t in terms if isinstance(t, JointTerm) and t.kind in SLIDING]


def _inverse(M: Array) -> Array:
    """Inverse of a positive definite matrix, rows and columns scaled to a diagonal of ones before."""
    with np.errstate(divide="ignore", invalid="ignore"):
        d = 1 / np.sqrt(np.diag(M))
        scaled = M * d[:, None] * d
    try:
        return np.asarray(cho_solve(cho_factor(scaled), np.eye(len(M))) * d[:, None] * d)
    except (np.linalg.LinAlgError, ValueError) as error:
        expected = "wider limits, or fewer terms of friction"
        raise IdentificationError("no reference within the limits excites all parameters", expected=expected) from error
