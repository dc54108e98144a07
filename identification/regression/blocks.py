"""Motions in blocks: that of the recording, of a robot simulated in its place, or with another
torque. All are asked alike, so that W and Z are the same columns along two motions.

A block filters any series as equation (6) of Janot2014 does, F[w x]: times the weights w of the
samples, then decimated. Recordings are read-only: no lag and no gain changes them, as these are
unknowns of the term `Drives`.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array, Ints
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
        recorded: whether the torque `tau` is the recorded one, which may be late; else it is that
            of the drives of a simulated or predicted robot.
    """

    problem: Problem
    near: slice
    inside: slice
    decimation: Decimation
    stride: int = 1
    recorded: bool = False

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
        of = self.problem.model, self.problem.base
        whole = _decimated(self, self.weights, *of, self.decimation, self.stride)
        return np.ascontiguousarray(whole[..., self.inside])

    @cached_property
    def known(self) -> Array:
        """Return F[w x] (n, rows) of the known torque x, zero for none."""
        if self.problem.signals.known_torque is None:
            return np.zeros_like(self.share)
        return self.weighted(self.problem.known(self.t_s).T)

    def weighted(self, x: Array, joints: Sequence[int] | Ints | slice = slice(None)) -> Array:
        """Return F[w x] (k, rows) of series x (k, N), one for each of some joints."""
        return self.filtered(self.weights[joints] * x)

    def filtered(self, x: Array) -> Array:
        """Return the rows (..., rows) of series x (..., N)."""
        return self.decimation.filtered(x)[..., self.inside]

    def kept(self, x: Array) -> Array:
        """Return the samples of x (N, k) at the instants of the rows, (rows, k)."""
        return self.decimation.kept(x)[self.inside]

    def rate(self, x: Array) -> Array:
        """Return dx/dt (N, k) of x (N, k), per second."""
        return differentiate(x, 1 / float(self.t_s[1] - self.t_s[0]))

    def own(self, x: Array) -> Array:
        """Return the samples of x (N, n) that no other block has."""
        return x[self.decimation.samples(self.inside, len(x))]

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
        found = copy(self)  # with its W
        vars(found).update(tau=tau - problem.known(self.t_s), recorded=False)
        return found


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
            recorded=True,
        )


def predicted_torque(
    motion: Motion, dynamics: InverseModel, base: BaseParameters, beta: Array, stride: int = 1
) -> Array:
    """Torque (N, n) of the inverse dynamic model along a motion, undecimated: IDM(q, dq, ddq)
    beta; links' as `smooth`.
    """
    model = direct_model(dynamics, base.standard_parameters(beta))
    rigid = smooth(model.torques_of_links, motion, stride)
    return model.torque(motion.q, motion.dq, motion.ddq, rigid=rigid)


def _decimated(
    motion: Motion,
    w: Array,
    dynamics: InverseModel,
    base: BaseParameters,
    decimation: Decimation,
    stride: int,
) -> Array:
    """Regressor (n, b, rows) with weights w (n, N), link columns at every `stride`-th sample."""
    N, W = (
        len(motion.q),
        np.zeros((len(dynamics.robot.joints), len(base.names), decimation.rows(len(motion.q)))),
    )
    strided = stride > 1 and stride * decimation.end_samples < N  # else most of it is the ends
    links = base.links & strided
    if links.any():
        at, end = (N - 1) % stride, decimation.end_samples
        spans = (slice(at, None, stride), slice(0, at + end + 1), slice(N - end - 1, None))
        entries, parts = _series(motion, dynamics, base, np.flatnonzero(links), spans)
        parts = [part * w[entries[:, 0], span] for part, span in zip(parts, spans, strict=True)]
        W[entries[:, 0], entries[:, 1]] = decimation.filtered_strided(*parts)
    entries, (series,) = _series(motion, dynamics, base, np.flatnonzero(~links), (slice(None),))
    for x, j in zip(series, entries[:, 0], strict=True):
        x *= w[j]
    W[entries[:, 0], entries[:, 1]] = decimation.filtered(series)
    return W


def _series(
    motion: Motion,
    dynamics: InverseModel,
    base: BaseParameters,
    places: Ints,
    spans: Sequence[slice],
) -> tuple[Ints, list[Array]]:
    """Entries (E, 2), joint and place in `base`, and their series (E, N) in spans of a motion."""
    columns = base.columns[places]
    entries = dynamics.entries(columns)
    entries[:, 1] = places[entries[:, 1]]
    return entries, [
        dynamics.series(motion.q[at], motion.dq[at], motion.ddq[at], columns) for at in spans
    ]
