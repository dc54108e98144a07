"""Tests of a recording against a priori links, by joint and by mistakes that they show.

The a priori links are of a URDF or of `[parameters]`, and serve as a witness of the recording.

The recorded torque of joint j is f_j times that of the a priori links, beside all that they do not
include (rotors, friction), with instruments and weights of the fit. Only rows of joint j
determine f_j: a wrong gain of a joint moves no other.

For mistakes these are a rotor, viscous and Coulomb friction, and an offset. So by joint

    tau_j = tau_links_j(q, dq, ddq) + [ddq_j, dq_j, sign(dq_j), 1] x_j,

with x_j by least squares, and each joint has the share of its square that is left. Each mistake
that a recording may have (`mistakes`) is undone in turn. A mistake moves whole columns, so the
links then explain the torques of all joints that it concerns. What is compared is therefore the sum
over the joints of the logarithms of these shares: one joint that is far better explained counts as
much as several that are a little better. The smallest sum is the cause, if it is below that of the
recording as it is by `MIN_CAUSE`; with it undone, a second one is looked for, and so on. Some 300
rows of the first recording suffice to find them, and motions that several mistakes share are
computed once. The links may be wrong by 30 %, so of mistakes that explain the torques nearly as
well the torque error of least squares decides, which does not depend on them.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial, reduce
from itertools import compress

import numpy as np

from ..arrays import Array, Ints
from ..errors import NoFitError
from ..estimation import MIN_COLUMN_NORM, instrumental_variables, intervals_of
from ..model import direct_model_of_base
from ..regression import row_states
from ..report import TrustResult, base_name
from .efforts import SAME_ERROR, Undone, errors_of, mistakes
from .evidence import Case, TrustInputs, Words, figures_of

MIN_FACTOR, MAX_FACTOR = 0.5, 2.0  # of a joint's torque over that of the prior's links
MAX_SPREAD = 1.5  # of equal factors
# A factor is judged only if the links explain at least this share of a joint's squared torque,
# because otherwise friction decides it.
MIN_EXPLAINED = 0.25
MIN_ALIKE = 0.9  # the same; below, other causes than a factor are looked for
MIN_LEFT = 0.01  # smallest share of a joint's square left by the prior's links that counts
MAX_LEFT = 0.25  # median of these shares with the causes undone; above, the links explain little
# Fall of the sum of the logarithms of these shares by which a cause is named. Of clean recordings,
# with links 0.5 to 1.6 times those of the robot, it is 0.1 at most.
MIN_CAUSE = 0.7
MIN_APART = 1.0  # by which other mistakes have to explain less to be no rivals


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
    found = causes_by_prior(evidence) if len(outside) or unlike else []
    cause = ", or ".join(one.text for one in found)
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
        causes=found[0].causes if len(found) == 1 else (),  # else it is not clear which one
        cause=cause,
        mend=found[0].advice(evidence.robot) if found else "",
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
    advice="Check what it names, drive gain, ratio, units, then the URDF.",
    detects="A joint torque that differs from that of the links in the URDF or `[parameters]`, if "
    "gains are known: the factor between them, with rotor and friction fitted too",
    limit="`caution`: the whole interval of a factor is below 0.5 or above 2; correcting a mistake "
    "(columns, unit, sign, zero, gravity) lets these links explain the torque far "
    "better; or all factors are near 0. `inconclusive`: all intervals are outside, by different "
    "factors",
    cases={
        "cause": Case(
            "caution",
            "{cause}. With this corrected, {links} explain the recorded torques",
            "{mend}",
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


def causes_by_prior(evidence: TrustInputs) -> list[Undone]:
    """Find the mistakes that, once undone, let the a priori links explain the torques far better.

    They are undone one by one, the best first. They are tried in some 300 rows of the first
    recording. Of mistakes that explain it nearly as well, those of the least torque error by least
    squares remain. If the result has several entries, it is not clear which one it is.
    """
    every, found = mistakes(evidence.robot), list[Undone]()
    left_by = partial(_unexplained, evidence, row_states(evidence.problem), every)
    left = left_by(done := every[0])
    while (size := left.sum(axis=1)).min() < size[0] - MIN_CAUSE:
        found.append(every[int(size.argmin())])
        left = left_by(done := found[-1].after(done))
    if not found or np.median(left[0]) > np.log(MAX_LEFT):
        return []
    tried = [
        one.after(others)
        for x in found
        for others in [
            reduce(lambda last, y: y.after(last), (y for y in found if y is not x), every[0])
        ]
        for size in [left_by(others).sum(axis=1)]
        for one in compress(every, size < size[every.index(x)] + MIN_APART)
        if one is not x
    ]
    errors = errors_of(evidence, [every[0], done, *tried])
    each = sorted(zip(errors[1:], [done, *tried], strict=True), key=lambda one: one[0])
    return [x for error, x in each if error <= SAME_ERROR * min(errors)]


def _unexplained(
    evidence: TrustInputs,
    states: tuple[Ints, Array, Array, Array],
    every: Sequence[Undone],
    done: Undone,
) -> Array:
    """Return what the a priori links leave of the torques (K, n) with each of K mistakes undone.

    It is the logarithm of each joint's share. `done` are the mistakes that are undone before.
    """
    at, *motion = states
    undone = [x.after(done) for x in every]
    A, P, t, d = (np.array([getattr(x, name) for x in undone]) for name in "APtd")
    q, dq, ddq = (np.einsum("kij,tj->kit", P, x) for x in motion)
    q += t[..., None]
    tau = np.einsum("kij,tj->kit", A, evidence.observed.tau[at])
    counts = np.einsum("kij,tj->kit", P.round(9) != 0, evidence.observed.share[at] <= 0) == 0
    rigid = _torque_of_links(evidence, (q, dq, ddq), d)
    J, Y = (
        np.stack(x, axis=3) * counts[..., None]
        for x in ((ddq, np.ones_like(q), dq, np.sign(dq)), (tau - rigid, tau))
    )
    left = ((Y - J @ (np.linalg.pinv(J) @ Y)) ** 2).sum(axis=2) + 1e-300
    return np.asarray(np.log(np.clip(left[..., 0] / left[..., 1], MIN_LEFT, 1.0)))


def _torque_of_links(evidence: TrustInputs, motion: Sequence[Array], along: Array) -> Array:
    """Return the torque (K, n, rows) of the a priori links along motions of this shape.

    The torque is with the payload. What is added to gravity is `along` (K, 3).
    """
    problem, payload = evidence.problem, evidence.arms[0].payload
    beta = np.array([evidence.prior.get(name, 0.0) for name in problem.base.names])
    beta += payload.values(evidence.estimate) * problem.base.links if payload else 0.0
    links = direct_model_of_base(problem.model, problem.base, beta)
    K, n, rows = motion[0].shape
    _, first, of = np.unique(
        motion[0].reshape(K, -1), axis=0, return_index=True, return_inverse=True
    )
    states = [x[first].swapaxes(1, 2).reshape(-1, n) for x in motion]
    rigid = links.torques_of_links(*states).reshape(-1, rows, n)[of.ravel()]
    for k in np.flatnonzero(along.any(axis=1)):
        rigid[k] += links.gravity(motion[0][k].T, along[k])
    return rigid.swapaxes(1, 2)
