"""A recording's system about one estimate after the other: only what load friction changes is made anew."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..model import direct_model
from ..regression import (
    LinkSeries,
    LoadFriction,
    Problem,
    Regression,
    load_friction,
    motion_blocks,
    regression_of_recording,
)


def links_at_rows(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Speeds and torque of the links, tau_rigid, (rows, n) each, at the instants of the rows; of a long recording the first."""
    motion, inside, _ = next(motion_blocks(problem))
    q, dq, ddq = (problem.settings.decimator.kept(x)[inside] for x in (motion.q, motion.dq, motion.ddq))
    links = direct_model(problem.model, problem.base.standard_parameters(np.where(problem.base.links, beta, 0.0)))
    return dq, links.torque(q, dq, ddq)


class LinearisedRecording:
    """A recording's W and Y about any parameters; all are the same where the robot has no load friction."""

    def __init__(self, problem: Problem, plain: Regression) -> None:
        """`plain` is the regression of the recording, its columns of load friction zero."""
        self._problem, self.plain = problem, plain
        self.load: LoadFriction = load_friction(problem.model, problem.base)
        self._last: tuple[Array, Regression] | None = None

    def at(self, beta: Array, load: LoadFriction | None = None) -> Regression:
        """W and Y about beta (b,), as of `load`; some of the load friction may do, columns of the rest are zero."""
        plain, problem, some = self.plain, self._problem, load is not None and load is not self.load
        load = self.load if load is None else load
        if not load:
            return plain
        if not some and self._last is not None and np.array_equal(self._last[0], beta):
            return self._last[1]
        if plain.reduced:
            made = regression_of_recording(problem, beta=beta)
        else:
            n, b = plain.tau.shape[1], problem.base.b
            parts = []
            for block in self._blocks():
                rigid = load.torque_of_links(block.entries, block.series, beta)
                parts.append(load.columns(rigid, block.dq, problem.settings.decimator)[..., block.inside])
            W = plain.system.W.reshape(n, -1, b).transpose(0, 2, 1).copy()
            Y = plain.system.Y.reshape(n, -1).copy()
            load.linearise(W, Y, np.concatenate(parts, axis=-1), beta)
            stacked = np.ascontiguousarray(W.transpose(0, 2, 1)).reshape(-1, b)
            made = replace(plain, system=replace(plain.system, W=stacked, Y=Y.reshape(-1)), links=())
        if not some:
            self._last = beta.copy(), made
        return made

    def _blocks(self) -> Iterator[LinkSeries]:
        """The links' part of the regressor before decimation, block by block."""
        if self.plain.links:
            yield from self.plain.links
            return
        model, base = self._problem.model, self._problem.base
        links = np.flatnonzero(base.links)
        entries = model.entries(base.columns[links])
        entries[:, 1] = links[entries[:, 1]]
        for motion, inside, _ in motion_blocks(self._problem):
            series = model.series(motion.q, motion.dq, motion.ddq, base.columns[links])
            yield self.load.series_of_links(entries, series, motion.dq, inside)
