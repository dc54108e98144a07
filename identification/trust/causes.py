"""Mistakes of a recording that a-priori links show.

The recorded torque of joint j should be that of the prior's links beside what the prior does not
know: a rotor, viscous and Coulomb friction, and an offset. So by joint

    tau_j = tau_links_j(q, dq, ddq) + [ddq_j, dq_j, sign(dq_j), 1] x_j,

with x_j by least squares, and each joint has the share of its square that is left. Each mistake
that a recording may have is undone in turn: efforts or positions of two joints are exchanged back,
positions are scaled, turned by a right angle or mirrored, gravity points along another axis. A
mistake moves whole columns, so the links then explain the torques of all joints that it concerns.
What is compared is therefore the sum over the joints of the logarithms of these shares: one joint
that is far better explained counts as much as several that are a little better. The smallest sum is
the cause, if it is below that of the recording as it is by `MIN_CAUSE`. Some 300 rows of the first
recording tell it, and motions that several mistakes share are computed once.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Ints
from ..model import direct_model
from ..regression import row_states
from .evidence import FitData, part_of

MIN_LEFT = 0.01  # smallest share of a joint's square left by the prior's links that counts
MIN_CAUSE = 1.5  # fall of the sum of the logarithms of these shares by which a cause is named
FACTORS = {"degrees": 180 / np.pi, "sign": -1.0}  # of positions


@dataclass(frozen=True, eq=False)
class Mistake:
    """A mistake, and how it is undone.

    Attributes:
        text: what is wrong; empty for the recording as it is.
        efforts, positions: (n,) the joints whose columns are taken for each joint.
        factors, turns: (n,) of these positions, and what is added to them then.
        gravity: (3,) what is added to the gravity of the description.
    """

    text: str
    efforts: Ints
    positions: Ints
    factors: Array
    turns: Array
    gravity: Array | None = None


def cause_by_prior(evidence: FitData) -> str:
    """The mistake that, undone, lets the prior's links explain the torques far better; "" for none,
    in some 300 rows of the first recording.
    """
    at, *motion = row_states(evidence.problem)
    mistakes = [*_mistakes(evidence.robot)]
    recorded, counts = evidence.observed.tau[at], evidence.observed.share[at] > 0
    efforts, positions = (
        np.array([getattr(x, name) for x in mistakes]) for name in ("efforts", "positions")
    )
    rigid, tau = _torque_of_links(evidence, motion, mistakes), recorded[:, efforts]
    q, dq, ddq = (x.T for x in motion)
    others = np.stack([ddq, dq, np.sign(dq), np.ones_like(q)], axis=2) * counts.T[..., None]
    others = np.linalg.qr(others)[0][positions]
    both = counts[:, positions, None] * np.stack([tau - rigid, tau], axis=3)
    both = both.transpose(1, 2, 0, 3)  # (mistakes, joints, rows, 2)
    left = ((both - others @ (others.swapaxes(2, 3) @ both)) ** 2).sum(axis=2)
    share = np.clip(left[..., 0] / (left[..., 1] + 1e-300), MIN_LEFT, 1.0)
    size = np.log(share).sum(axis=1)
    size[0] -= MIN_CAUSE
    return min(zip(size.tolist(), (one.text for one in mistakes), strict=True))[1]


def _mistakes(robot: Robot) -> Iterator[Mistake]:
    """The mistakes that are tried, first none."""
    names, same = [joint.name for joint in robot.joints], np.arange(robot.n)
    none = Mistake("", same, same, np.ones(robot.n), np.zeros(robot.n))
    yield none
    for a, b in combinations(same, 2):
        order, pair = same.copy(), {"one": names[a], "other": names[b]}
        order[[a, b]] = b, a
        yield replace(none, text=part_of("prior", "efforts", **pair), efforts=order)
        yield replace(none, text=part_of("prior", "positions", **pair), positions=order)
    own, gravity = np.eye(robot.n), np.array(robot.gravity)
    for joints, of in (*zip(own, names, strict=True), (none.factors, "all joints")):
        for unit, factor in FACTORS.items():
            factors = 1 + (factor - 1) * joints
            yield replace(none, text=part_of("prior", unit, one=of), factors=factors)
    for one, joint in zip(own, robot.joints, strict=True):
        for deg in (-90, 90, 180) if joint.type == "revolute" else ():
            text = part_of("prior", "zero", one=joint.name, deg=deg)
            yield replace(none, text=text, turns=-np.deg2rad(deg) * one)
    for along in (*np.eye(3), *-np.eye(3)) if not gravity[:2].any() else ():
        axis = f"{'-' if along.sum() < 0 else '+'}{'xyz'[int(np.abs(along).argmax())]}"
        turned = np.linalg.norm(gravity) * along - gravity
        yield replace(none, text=part_of("prior", "gravity", axis=axis), gravity=turned)


def _torque_of_links(
    evidence: FitData, motion: Sequence[Array], mistakes: Sequence[Mistake]
) -> Array:
    """(rows, mistakes, n) torque of the prior's links, with the payload, along the motions."""
    problem, payload = evidence.problem, evidence.arms[0].payload
    beta = np.array([evidence.prior.get(name, 0.0) for name in problem.base.names])
    beta += payload.values(evidence.estimate) * problem.base.links if payload else 0.0
    links = direct_model(problem.model, problem.base.standard_parameters(beta))
    each = np.array([(one.positions, one.factors, one.turns) for one in mistakes])
    motions, of_mistake = np.unique(each, axis=0, return_inverse=True)
    q, dq, ddq = (x[:, motions[:, 0].astype(int)] * motions[:, 1] for x in motion)
    states = (x.reshape(-1, q.shape[-1]) for x in (q + motions[:, 2], dq, ddq))
    rigid = links.torques_of_links(*states).reshape(q.shape)[:, of_mistake.ravel()]
    for k, one in enumerate(mistakes):
        if one.gravity is not None:
            rigid[:, k] += links.gravity(motion[0], one.gravity)
    return rigid
