"""Load friction, equation (H): mu times the absolute link torque, which depends
on the link parameters.

Per joint tau = ... + mu abs(tau_rigid) sign(dq), with tau_rigid the torque of the links alone on
the recording's own grid, before any decimation. Its columns about an estimate beta_k are
abs(tau_rigid) sign(dq) for mu, and for the links D = mu_k s W_links, s = sign(tau_rigid) sign(dq),
beside their own. In the rows of a joint with load friction

    Y + D beta_k = (W + D) beta + rho,

whose residual at beta = beta_k is that of the model itself: steps converge to the best fit, and
intervals are valid for mu and the links together.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..model import BaseParameters, InverseModel, JointTerm, direct_model
from .filtering import Decimation


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadFriction:
    """Joints (k,) with load friction, and the places (k,) of their mu in the b base
    parameters `base` of `model`.
    """

    joints: NDArray[np.intp]
    places: NDArray[np.intp]
    model: InverseModel
    base: BaseParameters

    def columns(
        self, q: Array, dq: Array, ddq: Array, w: Array, beta: Array, decimation: Decimation
    ) -> Array:
        """abs(tau_rigid) sign(dq) of these joints along a motion (N, n) about beta (b,), with the
        weights w (n, N) and decimated, and s at the rows: (2, k, rows).
        """
        rigid = torque_of_links(self.model, self.base, beta, q, dq, ddq)[:, self.joints].T
        sign = np.sign(dq[:, self.joints].T)
        # s is only a derivative: without the filter it does not move the solution.
        s = decimation.kept((np.sign(rigid) * sign).T).T
        return np.stack([decimation.filtered(w[self.joints] * np.abs(rigid) * sign), s])

    def linearise(self, W: Array, Y: Array | None, columns: Array, beta: Array) -> None:
        """Linearise W (n, b, rows), whose load columns are zero, and Y (n, rows)
        about beta (b,), in place.
        """
        links = self.base.links
        for j, place, column, s in zip(self.joints, self.places, *columns, strict=True):
            D = beta[place] * s * W[j, links]
            W[j, links] += D
            W[j, place] = column
            if Y is not None:
                Y[j] += beta[links] @ D


def load_friction(model: InverseModel, base: BaseParameters) -> LoadFriction | None:
    """The load friction in the base parameters of a robot; None if there is none."""
    found = [
        (int(source.rows[0]), place)
        for place, source in enumerate(model.sources[c] for c in base.columns)
        if isinstance(source, JointTerm) and source.kind == "load"
    ]
    if not found:
        return None
    joints, places = np.array(found, dtype=np.intp).T
    return LoadFriction(joints=joints, places=places, model=model, base=base)


def torque_of_links(
    model: InverseModel, base: BaseParameters, beta: Array, q: Array, dq: Array, ddq: Array
) -> Array:
    """tau_rigid (N, n) of base parameters beta (b,) along a motion."""
    links = direct_model(model, base.standard_parameters(np.where(base.links, beta, 0.0)))
    return links.torque(q, dq, ddq)
