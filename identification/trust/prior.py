"""Tests of a recording against a priori links, by joint and by mistakes that they show.

The a priori links are of a URDF or of `[parameters]`, and serve as a witness of the recording.

The recorded torque of joint j is f_j times that of the a priori links, beside all that they do not
include (rotors, friction), with instruments and weights of the fit. Only rows of joint j
determine f_j: a wrong gain of a joint moves no other.

For mistakes these are a rotor, viscous and Coulomb friction, and an offset. So by joint

    tau_j = tau_links_j(q, dq, ddq) + [ddq_j, dq_j, sign(dq_j), 1] x_j,

with x_j by least squares, and each joint has the share of its square that is left. Each mistake
that a recording may have is undone in turn: efforts or positions of two joints are exchanged back,
positions are scaled, turned by a right angle or mirrored, gravity points along another axis. A
mistake moves whole columns, so the links then explain the torques of all joints that it concerns.
What is compared is therefore the sum over the joints of the logarithms of these shares: one joint
that is far better explained counts as much as several that are a little better. The smallest sum is
the cause, if it is below that of the recording as it is by `MIN_CAUSE`. Some 300 rows of the first
recording suffice to find it, and motions that several mistakes share are computed once.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Ints
from ..errors import NoFitError
from ..estimation import MIN_COLUMN_NORM, instrumental_variables, intervals_of
from ..model import direct_model_of_base
from ..regression import row_states
from ..report import TrustResult, base_name
from .evidence import Case, TrustInputs, Words, figures_of

MIN_FACTOR, MAX_FACTOR = 0.5, 2.0  # of a joint's torque over that of the prior's links
MAX_SPREAD = 1.5  # of equal factors
# A factor is judged only if the links explain at least this share of a joint's squared torque,
# because otherwise friction decides it.
MIN_EXPLAINED = 0.25
MIN_ALIKE = 0.9  # the same; below, other causes than a factor are looked for
MIN_LEFT = 0.01  # smallest share of a joint's square left by the prior's links that counts
MIN_CAUSE = 1.5  # fall of the sum of the logarithms of these shares by which a cause is named
FACTORS = {"degrees": 180 / np.pi, "sign": -1.0}  # of positions


def prior_test(evidence: TrustInputs) -> TrustResult | None:
    """Compare each joint's torque with that of the a priori links.

    The test detects swapped joints and other units. The result is never `do not use`.
    """
    if not evidence.prior or evidence.gains:
        return None
    names = np.array([joint.name for joint in evidence.robot.joints])
    factor, half, explained, needed = _factors(evidence)
    lost = (needed > MIN_LEFT) & (half > 0) & (half < 0.5 * MIN_FACTOR)
    lost &= np.abs(factor) + half < MIN_FACTOR
    told = np.flatnonzero((explained > MIN_EXPLAINED) | lost)
    low, high = factor[told] - half[told], factor[told] + half[told]
    outside = told[(high < MIN_FACTOR) | (low > MAX_FACTOR)]
    unlike = ((needed > MIN_LEFT) & (explained < MIN_ALIKE)).any()
    cause = cause_by_prior(evidence) if len(outside) or unlike else ""
    values = np.sort(factor[outside if len(outside) else told])
    everywhere, negative = len(outside) == len(told) > 1, names[told[high < 0]]
    return PRIOR.judge(
        {
            "cause": cause,
            "unlike": not len(told),
            "ok": not len(outside),
            "links lost": lost[told].all(),
            "negative": len(negative),
            "everywhere": everywhere and values[-1] > max(MAX_SPREAD * values[0], 0.0),
            "off": True,
        },
        figures=figures_of(names[told], factor[told], half[told], np.ones(len(told))),
        cause=cause,
        source=evidence.prior_source,
        factors=" to ".join(dict.fromkeys(f"{x:.2g}" for x in [*values[:1], *values[-1:]])),
        each=", ".join(PRIOR.part("torque", joint=names[j], factor=factor[j]) for j in outside),
        everywhere=everywhere,
        some=not everywhere,
        negative=", ".join(negative),
    )


PRIOR = Words(
    test="a priori links",
    place=90,
    by=prior_test,
    advice="Check drive gain, ratio, units and order of columns, then the URDF.",
    detects="A joint torque that differs from that of the links in the URDF or `[parameters]`, if "
    "gains are known: the factor between them, with rotor and friction fitted too",
    limit="`caution`: the whole interval of a factor is below 0.5 or above 2; correcting a mistake "
    "(swapped columns, units, a sign, a zero, gravity) lets these links explain the torque far "
    "better; or all factors are near 0. `inconclusive`, not `caution`: all intervals are outside, "
    "by different factors. Never `do not use`",
    cases={
        "cause": Case(
            "caution",
            "{cause}. With this corrected, {links} explain the recorded torques",
            "Check this, and import again.",
            "{cause}?",
        ),
        "unlike": Case("ok", "no torque resembles that of {links}"),
        "ok": Case("ok", "{all_factors}"),
        "links lost": Case(
            "caution",
            "{all_factors}, so the efforts lack the links' torque",
            "Check the efforts for an external torque, noise or a dead channel, and the URDF.",
            "the efforts lack the links' torque",
        ),
        "negative": Case(
            "caution",
            "{off}",
            "Check the sign of effort and position of {negative}.",
            "{negative}: effort or position has the wrong sign",
        ),
        "everywhere": Case(
            "inconclusive", "the a priori links are wrong everywhere: {all_factors}"
        ),
        "off": Case(
            "caution", "{off}", "Check drive_gain, ratio, unit, payload and the URDF.", "{off}"
        ),
    },
    parts={
        "links": "the {source}'s links",
        "all_factors": "torques are {factors} times those of {links}",
        "everywhere": "{all_factors}",
        "some": "{each} that of {links}",
        "torque": "the torque of {joint} is {factor:.2g} times",
        "off": "{everywhere}{some}",
        "efforts": "recorded efforts of joints {one} and {other} swapped",
        "positions": "recorded positions of joints {one} and {other} swapped",
        "degrees": "position of {one} in rad declared as degrees",
        "sign": "wrong sign of the position of {one}",
        "zero": "zero of joint {one} wrong by {deg} deg",
        "gravity": "gravity along {axis} of the base (gravity_m_s2)",
    },
)


def known_and_free(evidence: TrustInputs) -> tuple[Array, Ints]:
    """Return the a priori values (p,) of the system's parameters, and indices of the others.

    The values are zero where there is no a priori value. Parameters with these indices are fitted
    instead.
    """
    names, estimated = evidence.observed.system.names, evidence.estimate.names
    values = np.array([evidence.prior.get(base_name(name), np.nan) for name in names])
    return np.nan_to_num(values), np.flatnonzero(np.isnan(values) & np.isin(names, estimated))


def _factors(evidence: TrustInputs) -> Array:
    """Return for each joint (4, n) its factor, its half-width, and two shares of variance.

    The half-width is half the 95 % interval of the factor. The shares are of the torque variance.
    Both shares leave out what is not of links: what the a priori links explain with the factor, and
    their own. Values are zero where the factor is not well determined.
    """
    system, (known, free) = evidence.observed.system, known_and_free(evidence)
    size, found = np.linalg.norm(system.W, axis=0), np.zeros((4, evidence.robot.n))
    for j in range(evidence.robot.n):
        own = system.joint_of_row == j
        one = system.part(own)
        acts = np.linalg.norm(one.W, axis=0) > MIN_COLUMN_NORM * size
        columns = np.c_[known, np.eye(len(known))[:, free[acts[free]]]]
        J, both = one.W @ columns, np.c_[one.Y, one.W @ known]
        apart = both - J[:, 1:] @ np.linalg.lstsq(J[:, 1:], both)[0]
        whole, needed = (apart**2).sum(axis=0) + 1e-300
        names = tuple(map(str, range(J.shape[1])))
        one = replace(one, W=J, joint_of_row=0 * one.joint_of_row, names=names, rows=one.rows[[j]])
        with suppress(NoFitError):
            fit = instrumental_variables(one, evidence.Z[own] @ columns, np.ones(1))
            found[:, j] = (
                fit.beta[0],
                intervals_of(one, fit).half[0],
                1 - fit.residual_norm**2 / whole,
                needed / whole,
            )
    return found


@dataclass(frozen=True, eq=False)
class Mistake:
    """A mistake, and how it is undone.

    Attributes:
        text: what is wrong; empty for the recording as it is.
        efforts, positions: (n,) the joints whose columns are taken for each joint.
        factors, turns: (n,) factors of these positions, and what is added to them then.
        gravity: (3,) what is added to the gravity of the description.
    """

    text: str
    efforts: Ints
    positions: Ints
    factors: Array
    turns: Array
    gravity: Array | None = None


def cause_by_prior(evidence: TrustInputs) -> str:
    """Find the mistake that, once undone, lets the a priori links explain the torques far better.

    It is tried in some 300 rows of the first recording; "" if there is none.
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
    """Return the mistakes to try, first none."""
    names, same = [joint.name for joint in robot.joints], np.arange(robot.n)
    none = Mistake("", same, same, np.ones(robot.n), np.zeros(robot.n))
    yield none
    for a, b in combinations(same, 2):
        order, pair = same.copy(), {"one": names[a], "other": names[b]}
        order[[a, b]] = b, a
        yield replace(none, text=PRIOR.part("efforts", **pair), efforts=order)
        yield replace(none, text=PRIOR.part("positions", **pair), positions=order)
    own, gravity = np.eye(robot.n), np.array(robot.gravity)
    for joints, of in (*zip(own, names, strict=True), (none.factors, "all joints")):
        for unit, factor in FACTORS.items():
            yield replace(none, text=PRIOR.part(unit, one=of), factors=1 + (factor - 1) * joints)
    for one, joint in zip(own, robot.joints, strict=True):
        for deg in (-90, 90, 180) if joint.type == "revolute" else ():
            yield replace(
                none,
                text=PRIOR.part("zero", one=joint.name, deg=deg),
                turns=-np.deg2rad(deg) * one,
            )
    for along in (*np.eye(3), *-np.eye(3)) if not gravity[:2].any() else ():
        axis = f"{'-' if along.sum() < 0 else '+'}{'xyz'[int(np.abs(along).argmax())]}"
        yield replace(
            none,
            text=PRIOR.part("gravity", axis=axis),
            gravity=np.linalg.norm(gravity) * along - gravity,
        )


def _torque_of_links(
    evidence: TrustInputs, motion: Sequence[Array], mistakes: Sequence[Mistake]
) -> Array:
    """Return the torque (rows, mistakes, n) of the a priori links along the motions.

    The torque is with the payload.
    """
    problem, payload = evidence.problem, evidence.arms[0].payload
    beta = np.array([evidence.prior.get(name, 0.0) for name in problem.base.names])
    beta += payload.values(evidence.estimate) * problem.base.links if payload else 0.0
    links = direct_model_of_base(problem.model, problem.base, beta)
    motions, of_mistake = np.unique(
        [(one.positions, one.factors, one.turns) for one in mistakes], axis=0, return_inverse=True
    )
    q, dq, ddq = (x[:, motions[:, 0].astype(int)] * motions[:, 1] for x in motion)
    states = (x.reshape(-1, q.shape[-1]) for x in (q + motions[:, 2], dq, ddq))
    rigid = links.torques_of_links(*states).reshape(q.shape)[:, of_mistake.ravel()]
    for k, one in enumerate(mistakes):
        if one.gravity is not None:
            rigid[:, k] += links.gravity(motion[0], one.gravity)
    return rigid
