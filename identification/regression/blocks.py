"""Motions in blocks: that of the recording, of a robot simulated in its place, or with another
torque. All are asked alike, so that W and Z are the same columns along two motions.

A block filters any series as equation (6) of Janot2014 does, F[w x]: times the weights w of the
samples, then decimated. Recordings are read-only: no lag and no gain changes them, as these are
unknowns of the term `Drives`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from ..arrays import Array, Bools, Ints
from ..model import BaseParameters, InverseModel, direct_model
from .filtering import Decimation
from .motion import Motion, differentiate, smooth
from .problem import Problem, row_blocks
from .weights import sample_weights, weights_at

DRIVES_A_ROW = 20  # at which the torque of a model is computed: its rate counts in the intervals


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionBlock(Motion):
    """A block of a motion, with the margins that the filters of its rows need.

    Attributes:
        problem: of the recording.
        near: the rows that it has samples of; `inside`: in these, its own ones; `decimation` leads
            from its samples to the rows.
        stride: step between samples that tell what links need: more than 1 for a low-passed motion.
    """

    problem: Problem
    near: slice
    inside: slice
    decimation: Decimation
    stride: int = 1

    def __getstate__(self) -> dict[str, Any]:
        """Take along all that rows need, so that another process needs no recording."""
        own = {name: getattr(self, name) for name in ("weights", "share", "known_torque")}
        return vars(self) | own | {"problem": self.problem.without_samples}

    @cached_property
    def weights(self) -> Array:
        """Return the weights (n, N) of the samples: 0 where a joint stands, 1 where it moves."""
        return weights_at(self.problem, self.t_s)

    @cached_property
    def share(self) -> Array:
        """Return the weights (n, rows) of the rows, 0 for those that do not count."""
        return sample_weights(self.problem).of_rows[self.near][self.inside].T

    @property
    def first(self) -> int:
        """Its first row."""
        return int(self.near.start + self.inside.start)

    @cached_property
    def W(self) -> Array:
        """Return the regressor (n, b, rows) F[w IDM]; columns of load friction are zero."""
        w, N, links = self.weights, len(self.q), self.problem.base.links
        found = np.zeros((len(w), len(links), self.decimation.rows(N)))
        # else most of it is the ends
        few = self.stride > 1 and self.stride * self.decimation.end_samples < N
        if (strided := links & few).any():
            at, end = (N - 1) % self.stride, self.decimation.end_samples
            spans = (slice(at, None, self.stride), slice(at + end + 1), slice(N - end - 1, None))
            entries, parts = self._series(strided, *spans)
            found[entries] = self.decimation.filtered_strided(*parts)
        entries, parts = self._series(~strided, slice(None))
        found[entries] = self.decimation.filtered(*parts)
        return np.ascontiguousarray(found[..., self.inside])

    def _series(self, of: Bools, *spans: slice) -> tuple[tuple[Ints, Ints], list[Array]]:
        """Joints and places (E,) of the entries of some columns, and in spans of the samples their
        weighted series (E, N).
        """
        model, places, parts = self.problem.model, np.flatnonzero(of), list[Array]()
        columns = self.problem.base.columns[places]
        joints, of_columns = model.entries(columns).T
        for at in spans:
            parts.append(model.series(self.q[at], self.dq[at], self.ddq[at], columns))
            for x, j in zip(parts[-1], joints, strict=True):
                x *= self.weights[j, at]
        return (joints, places[of_columns]), parts

    @cached_property
    def known_torque(self) -> Array:
        """Return the known torque (N, n) of its samples, N m or N, zero for none."""
        signals = self.problem.signals
        if signals.known_torque is None:
            return np.zeros(self.q.shape)
        at = np.rint(self.t_s * signals.sample_rate_hz).astype(np.intp)
        return np.asarray(signals.known_torque[at])

    def weighted(self, x: Array, joints: Sequence[int] | Ints | slice = slice(None)) -> Array:
        """Return F[w x] (k, rows) of series x (k, N), one for each of some joints."""
        return self.filtered(self.weights[joints] * x)

    def filtered(self, x: Array) -> Array:
        """Return the rows (..., rows) of series x (..., N)."""
        return self.decimation.filtered(x)[..., self.inside]

    def kept(self, x: Array) -> Array:
        """Return the samples of x (N, k) at the instants of the rows, (rows, k)."""
        return x[self.decimation.instants(len(x))][self.inside]

    def rate(self, x: Array) -> Array:
        """Return dx/dt (N, k) of x (N, k), per second."""
        return differentiate(x, 1 / float(self.t_s[1] - self.t_s[0]))

    @property
    def torque_stride(self) -> int:
        """Return the step between samples that tell a predicted torque."""
        return self.decimation.factor // DRIVES_A_ROW if self.problem.settings.filtered else 1

    def with_torque_of(self, beta: Array) -> "MotionBlock":
        """Return the same motion with the torque of the drives that base parameters beta (b,)
        predict, equation (1), which has no noise and is never late.
        """
        problem, stride = self.problem, self.torque_stride
        tau = predicted_torque(self, problem.model, problem.base, beta, stride)
        return self.with_torque(tau - self.known_torque)

    def with_torque(self, tau: Array) -> "MotionBlock":
        """Return the same motion, and all that was made of it, with another torque (N, n)."""
        found = object.__new__(MotionBlock)
        vars(found).update(vars(self), tau=tau)
        return found


class Candidate(Protocol):
    """What is asked for its columns along a motion of a recording, beside the terms."""

    @property
    def sliding(self) -> Array:
        """(c,) largest speeds along the directions of Coulomb friction."""

    def columns(self, motion: MotionBlock) -> Array:
        """(n, k, rows), weighted and decimated."""

    def at_rest(self, motion: MotionBlock) -> Array:
        """(n, g, rows) of links at rest, along the measured motion."""


def motion_blocks(problem: Problem) -> Iterator[MotionBlock]:
    """The recorded motion of the span used, low-passed, in blocks."""
    settings, decimation = problem.settings, problem.settings.decimator
    stride = decimation.stride_behind(settings.cutoff_hz, problem.signals.sample_rate_hz)
    for near, inside in row_blocks(problem):
        span = decimation.samples(near, settings.stop - settings.start)
        start, stop = (settings.start + k for k in (span.start, span.stop))
        yield MotionBlock(
            **vars(problem.motion.between(start, stop, settings.cutoff_hz)),
            problem=problem,
            near=near,
            inside=inside,
            decimation=decimation,
            stride=1 if problem.exact else stride,
        )


def predicted_torque(
    motion: Motion, dynamics: InverseModel, base: BaseParameters, beta: Array, stride: int = 1
) -> Array:
    """Torque (..., N, n) of the inverse dynamic model along a motion, undecimated: IDM(q, dq, ddq)
    beta, by beta (..., b); links' as `smooth`.
    """
    models = [
        direct_model(dynamics, base.standard_parameters(one)) for one in beta.reshape(-1, base.b)
    ]
    links, gravity = np.array([one.links for one in models]), dynamics.model.gravity.linear
    rigid = smooth(
        lambda *states: dynamics.torques_of_links(states, links, gravity).swapaxes(0, 1),
        motion,
        stride,
    ).swapaxes(0, 1)
    tau = [
        one.torque(motion.q, motion.dq, motion.ddq, rigid=of_links)
        for one, of_links in zip(models, rigid, strict=True)
    ]
    return np.reshape(tau, (*beta.shape[:-1], *motion.q.shape))
