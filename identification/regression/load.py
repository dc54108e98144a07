"""Load friction: mu times the size of the links' torque, which is known only where the parameters of the links are.

Per joint tau = ... + mu abs(tau_rigid) sign(dq), with tau_rigid = W_links beta_links on the recording's own grid, before any
decimation; W_links are the columns of the base parameters whose own parameter is a link's. About an estimate beta_k the
model is linear in the change of the parameters. In the rows of a joint with load friction

    Y + D beta_k = (W + D) beta + rho,    D = mu_k s W_links,    s = sign(tau_rigid) sign(dq),

W having abs(tau_rigid) sign(dq) as the column of mu. The residual at beta = beta_k is that of the model itself; solved again
and again this ends where the model fits best, in few passes, and intervals hold for mu and the links together.
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


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidBodyColumns:
    """The links' part of a block's regressor before decimation, in the rows of joints with load friction."""

    entries: NDArray[
        np.intp
    ]  # (E, 2) joint, ascending, and place among the base parameters; -1 and 0 for what is not of it
    series: Array  # (E, N)
    dq: Array  # (N, n)
    inside: slice  # the decimated rows that count


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadFriction:
    """The joints (k,) that have load friction, the places (k,) of their mu among the b base parameters, and `links` (b,)."""

    joints: NDArray[np.intp]
    places: NDArray[np.intp]
    links: NDArray[np.bool_]

    def of(self, places: Collection[int]) -> "LoadFriction | None":
        """That of which mu has one of these places; None where none has."""
        own = np.isin(self.places, list(places))
        return replace(self, joints=self.joints[own], places=self.places[own]) if own.any() else None

    def series_of_links(self, entries: NDArray[np.intp], series: Array, dq: Array, inside: slice) -> RigidBodyColumns:
        """The links' part, of these joints, of a block's regressor: its entries (E, 2) and their series (E, N)."""
        own = self.links[entries[:, 1]] & np.isin(entries[:, 0], self.joints)
        if own.mean() > 0.5:  # to copy most of it takes longer than to keep all
            return RigidBodyColumns(
                entries=np.where(own[:, None], entries, (-1, 0)), series=series, dq=dq, inside=inside
            )
        return RigidBodyColumns(entries=entries[own], series=series[own], dq=dq, inside=inside)

    def torque_of_links(self, entries: NDArray[np.intp], series: Array, beta: Array) -> Array:
        """tau_rigid (k, N) of these joints, from the series (E, N) of the regressor's entries (E, 2) and beta (b,)."""
        of_links = self.links[entries[:, 1]]
        rigid = np.zeros((len(self.joints), series.shape[1]))
        for i, j in enumerate(self.joints):
            own = of_links & (entries[:, 0] == j)
            together = slice(own.argmax(), len(own) - own[::-1].argmax())  # a slice is not copied
            values = np.where(own, beta[entries[:, 1]], 0.0)[together]
            rigid[i] = np.einsum("e,en->n", values, series[together])  # term by term: zeros in between change no bit
        return rigid

    def columns(self, block: RigidBodyColumns, beta: Array, decimation: Decimation) -> Array:
        """abs(tau_rigid) sign(dq) about beta (b,), decimated, then s at its rows: (2, k, rows) of those that count."""
        rigid, sign = self.torque_of_links(block.entries, block.series, beta), np.sign(block.dq[:, self.joints].T)
        # s serves as a derivative only: what it lacks of the filter does not move the solution.
        s = decimation.kept((np.sign(rigid) * sign).T).T
        return np.stack([decimation.filtered(np.abs(rigid) * sign), s])[..., block.inside]

    def linearise(self, W: Array, Y: Array | None, columns: Array, beta: Array) -> None:
        """Fill W (n, b, rows), whose load columns are zero, and Y (n, rows) with those about beta (b,); in place."""
        for j, place, column, s in zip(self.joints, self.places, *columns, strict=True):
            D = beta[place] * s * W[j, self.links]
            W[j, self.links] += D
            W[j, place] = column
            if Y is not None:
                Y[j] += beta[self.links] @ D


def load_friction(model: InverseModel, base: BaseParameters) -> LoadFriction | None:
    """Where the base parameters of a robot have load friction; None where they have none."""
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
    """`LoadFriction.columns` of a recording, from its `links` or, where these are not at hand, made anew."""
    problem = problem.with_samples()
    decimation, blocks = problem.settings.decimator, links or _link_blocks(problem, load)
    return np.concatenate([load.columns(block, beta, decimation) for block in blocks], axis=-1)


def _link_blocks(problem: Problem, load: LoadFriction) -> Iterator[RigidBodyColumns]:
    """The links' part of the regressor before decimation, in the blocks in which the problem's regressor was made."""
    model, base, links = problem.model, problem.base, np.flatnonzero(problem.base.links)
    entries = model.entries(base.columns[links])
    entries[:, 1] = links[entries[:, 1]]
    for motion, inside, _ in motion_blocks(problem):
        series = model.series(motion.q, motion.dq, motion.ddq, base.columns[links])
        yield load.series_of_links(entries, series, motion.dq, inside)
