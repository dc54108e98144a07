"""What a motion tells of the base parameters: the A-optimal criterion relative to a plain reference, and its gradient.

The information of a motion is M = sum of W'W / s², s the torque noise of each joint; the deviations of the parameters are
sigma = sqrt(diag(inv(M))). The criterion is log(mean((sigma / sigma of a plain reference)²)).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..arrays import Array
from ..errors import IdentificationError
from ..model import BaseParameters, InverseModel, JointTerm, regressor_gradient
from .series import Motion


@dataclass(frozen=True, kw_only=True, eq=False)
class Information:
    """Information of motions about the base parameters.

    Attributes:
        model, base: the inverse dynamic model, its base parameters.
        noise: (n,) deviation of each joint's torque in a row of the fit, in the unit of its effort.
        rows: of the fit in the whole recording, however many samples a motion is given by.
        earlier: (b, b) information of earlier recordings, which adds to that of the motion.
        creep: (n,) speeds at which Coulomb friction changes its sign in the criterion, as u / sqrt(u² + creep²): a jump has
            no gradient, and a fit leaves out rows of low speed.
    """

    model: InverseModel
    base: BaseParameters
    noise: Array
    rows: float
    earlier: Array
    creep: Array

    def sigma(self, motion: Motion) -> Array:
        """(b,) deviations of the parameters after a motion q, dq, ddq (N, n)."""
        return np.asarray(np.sqrt(np.diag(_inverse(self._of(self._regressor(motion))))))

    def criterion(self, motion: Motion, plain: Array) -> tuple[float, Motion]:
        """The criterion relative to the deviations `plain` (b,), and its gradients (N, n) by q, dq and ddq."""
        W = self._regressor(motion)
        for c, term, slip in self._coulomb(motion[1]):
            W[:, :, c] = _share(term) * (slip / np.sqrt(1 + slip**2) + term.side)[:, None] * term.direction
        C, D = _inverse(self._of(W)), 1 / plain**2
        total = float(D @ np.diag(C))
        # total = tr(D C), so d total = -tr(P dM) with P = C D C, and dM = 2 W'dW / s².
        G = -2 / total * self.rows / len(W) * (W / self.noise[:, None] ** 2) @ ((C * D) @ C)
        by_q, by_dq, by_ddq = regressor_gradient(self.model, self.base, motion, G)
        for c, term, slip in self._coulomb(motion[1]):
            slope = _share(term) * (1 + slip**2) ** -1.5 / (self.creep @ np.abs(term.direction))
            by_dq += (slope * (G[:, :, c] @ term.direction))[:, None] * term.direction
        return float(np.log(total / len(D))), (by_q, by_dq, by_ddq)

    def _regressor(self, motion: Motion) -> Array:
        """W (N, n, b)."""
        entries = self.model.entries(self.base.columns)
        W = np.zeros((*motion[0].shape, self.base.b))
        W[:, entries[:, 0], entries[:, 1]] = self.model.series(*motion, self.base.columns).T
        return W

    def _of(self, W: Array) -> Array:
        V = (W / self.noise[:, None]).reshape(-1, W.shape[-1])
        return np.asarray(V.T @ V * (self.rows / len(W)) + self.earlier)

    def _coulomb(self, dq: Array) -> Iterator[tuple[int, JointTerm, Array]]:
        """Columns of Coulomb friction, and the speeds (N,) that give their signs in units of the creep."""
        for c, column in enumerate(self.base.columns):
            source = self.model.sources[column]
            if isinstance(source, JointTerm) and source.kind == "coulomb":
                yield c, source, dq @ source.direction / (self.creep @ np.abs(source.direction))


def _share(term: JointTerm) -> float:
    """Friction of one direction is half of sign(u) + 1 or of sign(u) - 1."""
    return 0.5 if term.side else 1.0


def _inverse(M: Array) -> Array:
    """Inverse of a positive definite matrix, rows and columns scaled to a diagonal of ones before."""
    with np.errstate(divide="ignore", invalid="ignore"):
        d = 1 / np.sqrt(np.diag(M))
        scaled = M * d[:, None] * d
    try:
        return np.asarray(cho_solve(cho_factor(scaled), np.eye(len(M))) * d[:, None] * d)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise IdentificationError(
            "no reference within the limits excites all parameters", expected="wider limits, or fewer terms of friction"
        ) from error
