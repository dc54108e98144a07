"""Predictions of the recording by what was not fitted to it: cross-validation, and a-priori links.

Each block of time of one recording, or each of several recordings, is predicted by a fit of the
others, which may leave parameters undetermined. The rows of a part are those of its spans of time,
R factors of which have the same products.

The a-priori links, of a URDF or `[parameters]`, are a witness of the recording: by joint, held out,
and by exchanged joints. The recorded torque of joint j is f_j times that of the prior's links,
beside all that the prior does not know (rotors, friction), with instruments and weights of the fit.
Only rows of joint j determine f_j: a wrong gain of a joint moves no other.
"""

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np

from ..arrays import Array, Bools, Ints
from ..errors import NoFitError
from ..estimation import (
    MIN_COLUMN_NORM,
    Estimate,
    instrumental_variables,
    intervals_of,
    release_memory,
    spans_at,
    undetermined_parameters,
)
from ..model import base_prior, direct_model
from ..regression import base_name, row_states
from .evidence import FitData, HeldOut, Part, TrustLine, figures_of, first_case
from .words import WORDS

HELD_OUT = "held-out blocks"
BLOCKS = 5
MAX_HELD_OUT_RATIO_NOT_POSITIVE = 3.0  # the same, where M is not positive
MAX_HELD_OUT_RATIO = 1.5  # of held-out over training error, in weighted rows

# decimated torque (rows, n), that predicted by sets of estimates (K, rows, n), each of a set in an
# equal span of each recording, which rows count, by recording their instants, and the row of the
# fit at or after each
Predict = Callable[..., tuple[Array, Array, Bools, list[Array], list[Ints]]]
MIN_FACTOR, MAX_FACTOR = 0.5, 2.0  # of a joint's torque over that of the prior's links
MAX_SPREAD = 1.5  # of equal factors
# of a joint's square, without what is not of links, for its factor to be one of the prior's
MIN_EXPLAINED = 0.25
MIN_ALIKE = 0.9  # the same; below, other causes than a factor are looked for
MIN_LEFT = 0.01  # smallest share of a joint's square left by the prior's links that counts
MIN_CAUSE = 1.5  # fall of the sum of the logarithms of these shares by which a cause is named
UNITS = {
    "position of {} in rad declared as degrees": 180 / np.pi,
    "sign of the position of {}": -1.0,
}


def _predicted_parts(evidence: FitData) -> list[tuple[str, Part, Array, list[str]]]:
    """Five blocks of time of one recording, or each of several: name, spans of time, the parameters
    (b,) of the fit of the others that predict it, and which of them these do not determine; none
    where the others have too few rows. A recording's own parameters are fitted to it, as the others
    do not contain them.

    With drive gains the blocks are of each recording: none alone determines them.
    """
    estimate, several = evidence.estimate, evidence.by_recording
    own = [arm.own for arm in evidence.arms] if several else [set[str]()] * BLOCKS
    names = evidence.names if several else [f"block {k + 1}" for k in range(BLOCKS)]
    parts = evidence.spans(BLOCKS)
    if several:
        parts = [evidence.between(*both) for both in pairwise(evidence.ends)]
    elif sum(n := [evidence.count(part) for part in parts]) - max(n) <= len(estimate.beta):
        return []
    found = predictions_by_others([*map(evidence.factor, parts)], estimate.names, own)
    each = zip(names, parts, found, strict=True)
    # blocks are predicted anyway
    return [(name, part, beta, lost * several) for name, part, (beta, lost) in each]


def _held_out(
    evidence: FitData,
    parts: list[tuple[str, Part, Array, list[str]]],
    at: Ints,
    torques: tuple[Array, Array, Array, Bools],
) -> tuple[TrustLine | None, tuple[HeldOut, ...]]:
    """The line, and the errors of recordings, by rows of the spans `at` (T,): torques (T, n) as
    measured, by the fit and by the others, and which count.

    Errors in percent are of the torque; where the model does not hold, joints stand: those of
    weighted rows leave that out.
    """
    b, several, (tau, trained, by_others, counts) = (
        len(evidence.estimate.beta),
        evidence.by_recording,
        torques,
    )
    if not parts:
        why = f"not made: too few rows outside a block for {b} parameters; record longer"
        return TrustLine(HELD_OUT, "not made", why), ()
    errors, each = (tau, tau - by_others, tau - trained), list[HeldOut]()
    made, norms, without = list[str](), list[list[float]](), list[str]()
    for name, part, beta, its in parts:
        rows = counts & part[at][:, None]
        torque, *both = (float(np.linalg.norm(x[rows])) for x in errors)
        if told := torque > 0 and not its:
            made.append(name)
            weighted = (evidence.error(part, x) for x in (beta, evidence.estimate.beta))
            norms.append([torque, *both, *weighted])
        elif several:
            why = f"{', '.join(its[:8])} undetermined" if its else "it has no torque"
            without.append(f"{name} cannot be predicted by the others: {why}")
        if several:
            each.append(HeldOut(100 * both[0] / torque if told else None, tuple(its)))
    return _line_of(evidence, made, np.array(norms), without, several=several), tuple(each)


def _line_of(
    evidence: FitData, names: list[str], norms: Array, without: list[str], *, several: bool
) -> TrustLine | None:
    """The line of parts, by the norms (k, 5) of their torque, its errors held out and trained, and
    those of weighted rows; `without` tells of the other parts.
    """
    if not names:
        text = "; ".join(without) or "not made: no torque"
        return TrustLine(HELD_OUT, "cannot tell" if several else "not made", text)
    torque, error, training, held, trained = np.linalg.norm(norms, axis=0)
    percents = 100 * norms[:, 1:3] / norms[:, :1]
    error, training = 100 * error / torque, 100 * training / torque
    text = f"error {error:.3g} %{' of recordings' * several} held out, {training:.3g} % trained"
    text, ratio = "; ".join([text, *without]), held / max(trained, 1e-300)
    more = (
        f"{text}: the fit does not generalise ({ratio:.2g} times in weighted rows): "
        f"record {'more' if several else 'longer'}, with more varied motion, or fit with "
        "--essential"
        + ", or take the parameters of --consistent, which generalise better"
        * evidence.robot.gain_known
    )
    return first_case(
        HELD_OUT,
        (trained > 0 and ratio > MAX_HELD_OUT_RATIO, "caution", more, "does not generalise"),
        (True, "ok", text),
        value=float(error),
        figures=figures_of(names, percents[:, 0], 0 * percents[:, 0], percents[:, 1]),
        unit="%",
        fails_held_out=bool(trained > 0 and ratio > MAX_HELD_OUT_RATIO_NOT_POSITIVE),
    )


def predictions_by_others(
    factors: Sequence[Array], names: tuple[str, ...], own: Sequence[Collection[str]]
) -> list[tuple[Array, list[str]]]:
    """Parameters (b,) to predict each part by the fit of the others, its `own` ones fitted to it,
    from R factors of weighted rows [Z W Y]; and the names of those that the others do not
    determine.
    """
    found = list[tuple[Array, list[str]]]()
    size = np.linalg.norm(np.concatenate(factors)[:, len(names) : -1], axis=0)
    for k, its in enumerate(own):
        alone = np.array([name in its for name in names])
        others = np.concatenate([*factors[:k], *factors[k + 1 :]])[:, ~np.r_[alone, alone, False]]
        shared, beta = tuple(name for name in names if name not in its), np.zeros(len(names))
        Z, W, Y = np.split(others, [len(shared), -1], axis=1)
        Q = np.linalg.qr(Z / np.maximum(np.linalg.norm(Z, axis=0), 1e-300))[0]
        A, d = Q.T @ W, size[~alone]
        lost = undetermined_parameters(Z, shared) or undetermined_parameters(A, shared)
        beta[~alone] = np.linalg.lstsq(A / d, Q.T @ Y[:, 0], rcond=1e-12)[0] / d
        _, W, Y = np.split(factors[k], [len(names), -1], axis=1)
        beta[alone] = np.linalg.lstsq(W[:, alone], Y[:, 0] - W @ beta)[0]
        found.append((beta, lost))
    return found


def _betas(evidence: FitData, parts: list[tuple[str, Part, Array, list[str]]]) -> list[Estimate]:
    """The estimates that predict the parts, of those that others do not determine that of all."""
    estimate = evidence.estimate
    betas = [estimate.beta if lost else beta for _, _, beta, lost in parts]
    return [replace(estimate, beta=beta) for beta in betas] or [estimate]


def with_predictions(
    evidence: FitData, predict: Predict
) -> tuple[FitData, tuple[Array, Array, Bools, list[Array]]]:
    """The same with what the fit of other blocks or recordings predicts; and with the prior, and
    the held-out error of its links: all else is fitted to the others. Torques (T, n) as measured
    and by the fit, which rows count, and by recording their instants.
    """
    problem, system, estimate = evidence.problem, evidence.observed.system, evidence.estimate
    gain_known = evidence.robot.gain_known
    values, source = base_prior(problem.model, problem.base) if gain_known else ({}, "")
    release_memory(evidence.observed.C)
    evidence = replace(evidence, prior=values, prior_source=source * bool(values))
    cases = [(evidence, _predicted_parts(evidence))]
    sets = [[estimate], _betas(*cases[0])]
    if values and cases[0][1] and not evidence.gains:
        known, free = _known_and_free(evidence)
        rest, Z = replace(system, Y=system.Y - system.W @ known), evidence.Z[:, free]
        rest = rest.with_columns(free)
        with suppress(NoFitError):
            others = instrumental_variables(rest, Z, estimate.weights).without_rows()
            held = replace(evidence.observed, system=rest, Z=Z)
            by_links = replace(evidence, observed=held, estimate=others)
            cases.append((by_links, _predicted_parts(by_links)))
            some = (known + one.values_of(system.names) for one in _betas(*cases[1]))
            sets.append([replace(estimate, names=system.names, beta=beta) for beta in some])
    tau, (trained, *predicted), counts, t_s, instants = predict(
        *sets, by_recording=evidence.by_recording
    )
    at = spans_at(system.spans, instants)
    (line, by_others), *by_prior = (
        _held_out(of, parts, at, (tau, trained, one, counts))
        for (of, parts), one in zip(cases, predicted, strict=True)
    )
    error = next((one.value for one, _ in by_prior if one is not None), None)
    made = replace(evidence, held_out=line, by_others=by_others, prior_error_percent=error)
    return made, (tau, trained, counts, t_s)


def prior_test(evidence: FitData) -> TrustLine | None:
    """By joint its torque over that of the prior's links; joints that seem exchanged or in other
    units. Never `do not use`.
    """
    if not evidence.prior or evidence.gains:
        return None
    names, links = (
        [joint.name for joint in evidence.robot.joints],
        f"the {evidence.prior_source}'s links",
    )
    factor, half, explained, needed = _factors(evidence)
    lost = (needed > MIN_LEFT) & (half > 0) & (half < 0.5 * MIN_FACTOR)
    lost &= np.abs(factor) + half < MIN_FACTOR
    told = np.flatnonzero((explained > MIN_EXPLAINED) | lost)
    low, high = factor[told] - half[told], factor[told] + half[told]
    outside = told[(high < MIN_FACTOR) | (low > MAX_FACTOR)]
    unlike = ((needed > MIN_LEFT) & (explained < MIN_ALIKE)).any()
    cause = _cause(evidence) if len(outside) or unlike else ""
    values = np.sort(factor[outside if len(outside) else told])
    everywhere = len(outside) == len(told) > 1
    between = " to ".join(dict.fromkeys(f"{x:.2g}" for x in [*values[:1], *values[-1:]]))
    text = f"torques are {between} times what {links} need"
    torques = ", ".join(f"torque of {names[j]} is {factor[j]:.2g} times" for j in outside)
    negative = [names[j] for j in told if factor[j] + half[j] < 0]
    off = text if everywhere else f"{torques} what {links} need"
    spread = everywhere and values[-1] > max(MAX_SPREAD * values[0], 0.0)
    return first_case(
        "prior",
        (cause, "caution", f"{cause}? {links} then need the recorded torques", cause),
        (not len(told), "ok", f"no torque is like that of {links}"),
        (not len(outside), "ok", text),
        (
            lost[told].all(),
            "caution",
            WORDS["links lost"].format(text=text),
            WORDS["links lost, in short"],
        ),
        (
            negative,
            "caution",
            f"{off}: effort or position of {', '.join(negative)} has the wrong sign?",
            WORDS["wrong sign"].format(joints=", ".join(negative)),
        ),
        (spread, "cannot tell", f"the prior is off everywhere: {text}"),
        (True, "caution", f"{off}: drive_gain, ratio, unit, a payload, or the prior?", off),
        figures=figures_of(np.array(names)[told], factor[told], half[told], np.ones(len(told))),
    )


def _known_and_free(evidence: FitData) -> tuple[Array, Ints]:
    """(p,) values of the system's parameters by the prior, zero where it has none; places of those
    that are fitted instead.
    """
    names, estimated = evidence.observed.system.names, evidence.estimate.names
    values = np.array([evidence.prior.get(base_name(name), np.nan) for name in names])
    return np.nan_to_num(values), np.flatnonzero(np.isnan(values) & np.isin(names, estimated))


def _factors(evidence: FitData) -> Array:
    """By joint (4, n) its factor and half the 95 % interval of that, and shares of the square of
    its torque, both without what is not of links: what the prior's links explain with the factor,
    and their own. Zeros where it is undetermined.
    """
    system, (known, free) = evidence.observed.system, _known_and_free(evidence)
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
            half = intervals_of(one, fit).half[0]
            found[:, j] = fit.beta[0], half, 1 - fit.residual_norm**2 / whole, needed / whole
    return found


def _cause(evidence: FitData) -> str:
    """What, corrected, lets the prior's links explain the torques far better, in some 300 rows
    of the first recording.
    """
    problem, payload = evidence.problem, evidence.arms[0].payload
    names, (at, *motion) = [joint.name for joint in evidence.robot.joints], row_states(problem)
    base, same, none = problem.base, np.arange(len(names)), np.zeros(len(names))
    beta = np.array([evidence.prior.get(name, 0.0) for name in base.names])
    beta += payload.values(evidence.estimate) * base.links if payload else 0.0
    links = direct_model(problem.model, base.standard_parameters(beta))
    recorded, counts = evidence.observed.tau[at], evidence.observed.share[at] > 0
    # efforts and positions taken from these joints, positions times a factor and turned
    cases = [("", same, same, none + 1, none)]
    for a, b in combinations(same, 2):
        order, pair = same.copy(), f"of joints {names[a]} and {names[b]} exchanged"
        order[[a, b]] = b, a
        cases.append((f"recorded efforts {pair}", order, *cases[0][2:]))
        cases.append((f"recorded positions {pair}", same, order, *cases[0][3:]))
    for own, of in [*zip(np.eye(len(names)), names, strict=True), (none + 1, "all joints")]:
        for text, factor in UNITS.items():
            cases.append((text.format(of), same, same, 1 + (factor - 1) * own, none))
    for own, joint in zip(np.eye(len(names)), evidence.robot.joints, strict=True):
        for deg in (-90, 90, 180) if joint.type == "revolute" else ():
            text = WORDS["zero off"].format(joint=joint.name, deg=deg)
            cases.append((text, *cases[0][1:-1], -np.deg2rad(deg) * own))
    gravity = np.array(evidence.robot.gravity)
    directions = [*np.eye(3), *-np.eye(3)] if gravity[:2].any() == 0 else []
    for along in directions:
        sign, axis = "-" if along.sum() < 0 else "+", "xyz"[int(np.abs(along).argmax())]
        cases.append((WORDS["gravity"].format(sign=sign, axis=axis), *cases[0][1:]))
    texts, *each = zip(*cases, strict=True)
    efforts, positions, *_ = map(np.array, each)
    motions, of_case = np.unique(np.stack(each[1:], axis=1), axis=0, return_inverse=True)
    q, dq, ddq = (x[:, motions[:, 0].astype(int)] * motions[:, 1] for x in motion)
    states = (x.reshape(-1, len(names)) for x in (q + motions[:, 2], dq, ddq))
    rigid = links.torques_of_links(*states).reshape(q.shape)[:, of_case.ravel()]
    for k, along in enumerate(directions, len(cases) - len(directions)):
        rigid[:, k] += links.gravity(motion[0], np.linalg.norm(gravity) * along - gravity)
    q, dq, ddq = (x.T for x in motion)
    others = np.stack([ddq, dq, np.sign(dq), np.ones_like(q)], axis=2) * counts.T[..., None]
    others, tau = np.linalg.qr(others)[0][positions], recorded[:, efforts]
    both = counts[:, positions, None] * np.stack([tau - rigid, tau], axis=3)
    both = both.transpose(1, 2, 0, 3)  # (cases, joints, rows, 2)
    left = ((both - others @ (others.swapaxes(2, 3) @ both)) ** 2).sum(axis=2)
    share = np.clip(left[..., 0] / (left[..., 1] + 1e-300), MIN_LEFT, 1.0)
    size = np.log(share).sum(axis=1)
    size[0] -= MIN_CAUSE
    return str(min(zip(size.tolist(), texts, strict=True))[1])
