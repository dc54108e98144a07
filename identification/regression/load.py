"""Load friction: mu times the absolute link torque, which depends on the link parameters.

Per joint tau = ... + mu abs(tau_rigid) sign(dq), with tau_rigid = W_links beta_links on the recording's own grid, before any
decimation; W_links are the columns of the base parameters named after a link parameter. About an estimate beta_k the
model is linear in the change of the parameters. In the rows of a joint with load friction

    Y + D beta_k = (W + D) beta + rho,    D = mu_k s W_links,    s = sign(tau_rigid) sign(dq),

W having abs(tau_rigid) sign(dq) as the column of mu. The residual at beta = beta_k is that of the model itself; repeated
solving converges to the best fit in few passes, and intervals are valid for mu and the links together.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import one_thread
from ..model import BaseParameters, InverseModel, JointTerm
from .filtering import Decimation
from .problem import Problem, motion_blocks
from .weights import weights_at


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidBodyColumns:
    """Link columns of the regressor of a block before decimation, for joints with load friction."""

    # (E, 2) joint, ascending, and place in the base parameters; -1 and 0 for entries that are not used
    entries: NDArray[np.intp]
    series: Array  # (E, N)
    dq: Array  # (N, n)
    weights: Array  # (n, N) of the samples
    inside: slice  # the decimated rows of the block


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadFriction:
    """Joints (k,) with load friction, places (k,) of their mu in the b base parameters, and `links` (b,): link parameters."""

    joints: NDArray[np.intp]
    places: NDArray[np.intp]
    links: NDArray[np.bool_]

    def of(self, places: Collection[int]) -> "LoadFriction | None":
        """The part whose mu have one of these places; None if there is none."""
        own = np.isin(self.places, list(places))
        return replace(self, joints=self.joints[own], places=self.places[own]) if own.any() else None

    def series_of_links(
        self, entries: NDArray[np.intp], series: Array, dq: Array, weights: Array, inside: slice
    ) -> RigidBodyColumns:
        """Link columns, for these joints, of the regressor of a block with entries (E, 2) and their series (E, N)."""
        own = self.links[entries[:, 1]] & np.isin(entries[:, 0], self.joints)
        if own.mean() > 0.5:  # copying most of it is slower than keeping all
            entries = np.where(own[:, None], entries, (-1, 0))
        else:
            entries, series = entries[own], series[own]
        return RigidBodyColumns(entries=entries, series=series, dq=dq, weights=weights, inside=inside)

    def torque_of_links(self, entries: NDArray[np.intp], series: Array, beta: Array) -> Array:
        """tau_rigid (k, N) of these joints, from the series (E, N) of the regressor's entries (E, 2) and beta (b,)."""
        of_links = self.links[entries[:, 1]]
        rigid = np.zeros((len(self.joints), series.shape[1]))
        for i, j in enumerate(self.joints):
            own = of_links & (entries[:, 0] == j)
            together = slice(own.argmax(), len(own) - own[::-1].argmax())  # a slice is not copied
            values = np.where(own, beta[entries[:, 1]], 0.0)[together]
            rigid[i] = np.einsum("e,en->n", values, series[together])  # zeros in between change no bit
        return rigid

    def columns(self, block: RigidBodyColumns, beta: Array, decimation: Decimation) -> Array:
        """abs(tau_rigid) sign(dq) about beta (b,), weighted and decimated, and s at the rows of the block: (2, k, rows)."""
        rigid, sign = self.torque_of_links(block.entries, block.series, beta), np.sign(block.dq[:, self.joints].T)
        # s is only a derivative: without the filter it does not move the solution.
        s = decimation.kept((np.sign(rigid) * sign).T).T
        return np.stack([decimation.filtered(block.weights[self.joints] * np.abs(rigid) * sign), s])[..., block.inside]

    def linearise(self, W: Array, Y: Array | None, columns: Array, beta: Array) -> None:
        """Linearise W (n, b, rows), whose load columns are zero, and Y (n, rows) about beta (b,), in place."""
        for j, place, column, s in zip(self.joints, self.places, *columns, strict=True):
            D = beta[place] * s * W[j, self.links]
            W[j, self.links] += D
            W[j, place] = column
            if Y is not None:
                Y[j] += beta[self.links] @ D


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
    return LoadFriction(joints=joints, places=places, links=base.links)


@one_thread
def load_columns(problem: Problem, links: tuple[RigidBodyColumns, ...], load: LoadFriction, beta: Array) -> Array:
    """`LoadFriction.columns` of a recording, from its `links` or, without these, computed again."""
    problem = problem.with_samples()
    decimation, blocks = problem.settings.decimator, links or _link_blocks(problem, load)
    return np.concatenate([load.columns(block, beta, decimation) for block in blocks], axis=-1)


def _link_blocks(problem: Problem, load: LoadFriction) -> Iterator[RigidBodyColumns]:
    """Link columns of the regressor before decimation, in the blocks of the regressor."""
    model, base, links = problem.model, problem.base, np.flatnonzero(problem.base.links)
    entries = model.entries(base.columns[links])
    entries[:, 1] = links[entries[:, 1]]
    for motion, inside, _ in motion_blocks(problem):
        series = model.series(motion.q, motion.dq, motion.ddq, base.columns[links])
        yield load.series_of_links(entries, series, motion.dq, weights_at(problem, motion.t_s), inside)
