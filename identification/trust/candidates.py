"""Terms that the model may lack.

They compute their columns along a motion as the terms of the model do. Their kinds are in `kinds`.
"""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from ..arrays import Array
from ..model import DirectModel, inertia_unit, torque_of_links
from ..regression import MotionBlock, smooth
from .kinds import IN_FAST_ROWS, KINDS, LAG, MIN_TAKEN_PERCENT, About, stride_of

MIN_T = 5.0  # deviations, above chance


@dataclass(frozen=True, kw_only=True)
class MissingTerm:
    """A term that the model may lack.

    Attributes:
        kind, where: the term, and its joint or axis.
        place: the number of its kind, and its place within that kind.
        column: of C, -1 for none.
        joint: the joint in whose rows the term has a column of its own; None for all rows.
        unit, advice: unit of the coefficient; what to do.
        value, t: the coefficient, and its ratio to its standard error.
        taken_percent: share of the residual variance that the term explains.
        together_percent: the same of all columns of its kind.
        moves: largest shift of an essential parameter, in half-widths.
        least_percent: `taken_percent` above which the term counts as large.
        noticed: size of the coefficient that is noticed in nearly every recording; infinite if the
            model already explains the term.
    """

    kind: str
    where: str
    unit: str
    advice: str
    place: tuple[int, int] = (0, 0)
    column: int = 0
    joint: int | None = None
    value: float = 0.0
    t: float = 0.0
    taken_percent: float = 0.0
    together_percent: float = 0.0
    moves: float = 0.0
    least_percent: float = MIN_TAKEN_PERCENT
    noticed: float = np.inf

    @property
    def finding(self) -> str:
        """A few words on what is wrong."""
        return f"{self.kind} {self.where}{KINDS[self.place[0]].missing}"

    @property
    def found(self) -> bool:
        """True if the term is significant and large."""
        large = self.kind != LAG and self.taken_percent > self.least_percent
        return abs(self.t) > MIN_T and (large or (self.moves > 1 and self.kind in IN_FAST_ROWS))


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates(About):
    """Terms that the model of a recording lacks; their columns are computed along any motion.

    `sliding` (c,): largest speeds along the directions of Coulomb friction.
    """

    sliding: Array

    @cached_property
    def terms(self) -> tuple[MissingTerm, ...]:
        """The candidate terms."""
        robot, found, columns = self.robot, list[MissingTerm](), dict[tuple[int, int], int]()
        for i, kind in enumerate(KINDS):
            for k, (where, j) in enumerate(kind.at(self)):
                if kind.friction in robot.joints[j].terms or not kind.lacks(self, k):
                    continue
                listed = kind.listed and isinstance(robot.joints[j].friction, tuple)
                place = i, k if kind.everywhere else k % kind.parts
                found.append(
                    MissingTerm(
                        kind=kind.name,
                        where=where,
                        unit=kind.unit.format(
                            effort=robot.effort_units[j],
                            position=robot.joints[j].position_unit,
                            zero="deg" if robot.joints[j].type == "revolute" else "mm",
                            inertia=inertia_unit(robot, j),
                        ),
                        advice=f'add "{kind.friction}" to its friction' if listed else kind.advice,
                        place=(i, k),
                        column=columns.setdefault(place, len(columns)) if kind.torque else -1,
                        joint=None if kind.everywhere else j,
                        least_percent=kind.least_percent(self),
                    )
                )
        return tuple(found)

    def at_rest(self, motion: MotionBlock) -> Array:
        """Return the torques of `weighs` at rest, shape (n, g, rows), weighted and decimated.

        They change slowly along the measured motion.
        """
        q, columns = motion.kept(motion.q), motion.problem.base.columns[self.weighs]
        still = motion.problem.model.regressor(q, 0 * q, 0 * q)[:, :, columns]
        return motion.filtered(motion.weights)[:, None] * still.transpose(1, 2, 0)

    def columns(self, motion: MotionBlock) -> Array:
        """Return the torque per unit of each term, shape (n, k, rows), weighted and decimated.

        The motion is given; the torque that a term scales is the one that `beta` predicts.
        """
        of_columns = {term.column: term for term in self.terms if term.column >= 0}
        found = np.zeros((len(self.peak), len(of_columns), len(motion.share.T)))
        links = smooth(partial(_of_links, self.links, self.robot.zero), motion, stride_of(motion))
        for column, term in of_columns.items():
            kind, k = KINDS[term.place[0]], term.place[1]
            assert kind.torque is not None
            torque = kind.torque(self, motion, links, k)
            if len(at := np.flatnonzero(np.einsum("tj,tj->j", torque, torque))):
                found[at, column] = motion.weighted(torque.T[at], at)
        return found


def _of_links(links: DirectModel, zero: Array, q: Array, dq: Array, ddq: Array) -> Array:
    """Return the links' torque along a motion with its derivatives, shape (N, n, 1 + 2n).

    The derivatives are those by the positions, and by factors on each joint's motion from its zero.
    """
    tau, slopes = torque_of_links(links, (q, dq, ddq))
    by_factor = sum(of * x[:, None] for of, x in zip(slopes, (q - zero, dq, ddq), strict=True))
    return np.concatenate([tau[..., None], slopes[0], by_factor], axis=2)
