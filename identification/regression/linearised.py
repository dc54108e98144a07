"""W and Y of recordings about one estimate after the other: only what load friction changes is made anew."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import Serial, Work
from ..estimation import one_thread
from ..model import BaseParameters
from .load import LinkSeries, LoadFriction, load_friction
from .own import OwnParameters
from .place import Place
from .problem import Problem, motion_blocks
from .system import ALL_REDUCED, Regression, regression_of_recording, stacked


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearised:
    """W and Y of recordings about any parameters; all are the same where the robot has no load friction.

    Attributes:
        problem: of one recording; robot, model and base parameters are those of all, and warnings name what is left out.
        each: by recording, its regression; columns of load friction are zero.
        places: by recording, where tasks find it.
        parameters: those that the recordings share, and those of each.
        work: where tasks run.
        left_out: friction terms that were left out of the description, each with a line that says why.
    """

    problem: Problem
    each: tuple[Regression, ...]
    places: tuple[Place, ...]
    parameters: OwnParameters
    work: Work = field(default_factory=Serial)
    left_out: dict[str, str] = field(default_factory=dict)
    _last: list[tuple[Array, tuple[Regression, ...], Regression]] = field(default_factory=list)

    @cached_property
    def load(self) -> LoadFriction:
        """Where the base parameters have load friction."""
        return load_friction(self.problem.model, self.problem.base)

    @cached_property
    def plain(self) -> Regression:
        """The system that the recordings make together; its columns of load friction are zero."""
        return self._together(self.each)

    def load_places(self, load: LoadFriction | None = None) -> NDArray[np.intp]:
        """Where the parameters of load friction are among those of the system; of `load`, or of all there is."""
        names, among = self.problem.base.names, self.parameters.names
        places = (self.load if load is None else load).places
        return np.array([among.index(names[place]) for place in places], dtype=np.intp)

    def at(self, beta: Array, load: LoadFriction | None = None) -> Regression:
        """W and Y about beta (b,), values of all parameters.

        `load` may be some of the load friction: columns of the rest are zero. Not of reduced rows.
        """
        return self._about(beta, load)[1]

    def each_at(self, beta: Array) -> tuple[Regression, ...]:
        """The same of each recording, with columns of its base parameters."""
        return self._about(beta, None)[0]

    def without(self, left_out: dict[str, str]) -> "Linearised":
        """The same without friction terms that are regrouped with nothing; `left_out` says why of each."""
        if not left_out:
            return self
        return replace(
            self,
            problem=without_terms(self.problem, left_out),
            each=tuple(_without_columns(one, left_out) for one in self.each),
            parameters=self.parameters.without(left_out),
            left_out=self.left_out | left_out,
            _last=[],
        )

    def _about(self, beta: Array, load: LoadFriction | None) -> tuple[tuple[Regression, ...], Regression]:
        some, load = load is not None and load is not self.load, self.load if load is None else load
        if not load:
            return self.each, self.plain
        for last, each, whole in self._last:
            if not some and np.array_equal(last, beta):
                return each, whole
        of_each = [beta[self.parameters.places(k)] for k in range(len(self.each))]
        base = self.problem.base
        if self.plain.reduced:
            places = zip(self.places, of_each, strict=True)
            each = tuple(self.work.run(reduced_regression_at, [(place, base, own) for place, own in places]))
        else:
            tasks = [
                (place, one.links, base, load, own)
                for place, one, own in zip(self.places, self.each, of_each, strict=True)
            ]
            each = tuple(
                _linearised(one, load, columns, own)
                for one, columns, own in zip(self.each, self.work.run(load_columns, tasks), of_each, strict=True)
            )
        whole = self._together(each)
        if not some:
            self._last[:] = [(beta.copy(), each, whole)]
        return each, whole

    def _together(self, each: tuple[Regression, ...]) -> Regression:
        return stacked([self.parameters.widened(one, k) for k, one in enumerate(each)])


def without_terms(problem: Problem, left_out: dict[str, str]) -> Problem:
    """The identification without friction terms that are regrouped with nothing; its warnings have the reasons."""
    if not left_out:
        return problem
    settings = replace(problem.settings, warnings=(*problem.settings.warnings, *left_out.values()))
    return replace(problem, base=problem.base.without(left_out), settings=settings)


@one_thread
def load_columns(
    place: Place, links: tuple[LinkSeries, ...], base: BaseParameters, load: LoadFriction, beta: Array
) -> Array:
    """`LoadFriction.columns` of a recording."""
    problem, parts = place.problem(), []
    # What is at hand is never sent to another process: there it is made anew.
    for block in links or _blocks(problem, base, load):
        parts.append(load.columns(block, beta, problem.settings.decimator))
    return np.concatenate(parts, axis=-1)


@one_thread
def reduced_regression_at(place: Place, base: BaseParameters, beta: Array) -> Regression:
    """W and Y of a recording about beta (b,), as QR factors."""
    return regression_of_recording(replace(place.problem(), base=base), share=ALL_REDUCED, beta=beta)


def _blocks(problem: Problem, base: BaseParameters, load: LoadFriction) -> Iterator[LinkSeries]:
    """The links' part of the regressor before decimation, in the blocks in which the problem's regressor was made."""
    model, links = problem.model, np.flatnonzero(base.links)
    entries = model.entries(base.columns[links])
    entries[:, 1] = links[entries[:, 1]]
    for motion, inside, _ in motion_blocks(problem):
        series = model.series(motion.q, motion.dq, motion.ddq, base.columns[links])
        yield load.series_of_links(entries, series, motion.dq, inside)


def _linearised(plain: Regression, load: LoadFriction, columns: Array, beta: Array) -> Regression:
    """Rows that are not reduced, about beta (b,), from the columns (2, k, rows) of load friction."""
    n, b = plain.tau.shape[1], len(beta)
    W, Y = plain.system.W.copy(), plain.system.Y.copy()
    load.linearise(W.reshape(n, -1, b).transpose(0, 2, 1), Y.reshape(n, -1), columns, beta)
    return replace(plain, system=replace(plain.system, W=W, Y=Y), links=())


def _without_columns(regression: Regression, left_out: dict[str, str]) -> Regression:
    """The regression without the columns of parameters; the links' entries are at their places among the others."""
    kept = np.array([name not in left_out for name in regression.system.names])
    place = np.cumsum(kept) - 1
    links = tuple(
        replace(part, entries=np.c_[part.entries[:, 0], place[part.entries[:, 1]]]) for part in regression.links
    )
    return replace(regression, system=regression.system.with_columns(np.flatnonzero(kept)), links=links)
