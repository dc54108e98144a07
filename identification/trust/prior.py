"""A-priori links, of a URDF or `[parameters]`, as a witness of the recording: by joint, held
out, and exchanged joints.

The recorded torque of joint j is f_j times that of the prior's links, beside all that the prior
does not know (rotors, friction), with instruments and weights of the fit. Only rows of joint j
determine f_j: a wrong gain of a joint moves no other.
"""

from contextlib import suppress
from dataclasses import replace
from itertools import combinations

import numpy as np

from ..arrays import Array, Ints
from ..errors import NoFitError
from ..estimation import MIN_COLUMN_NORM, Estimate, instrumental_variables, intervals_of
from ..model import base_prior, direct_model
from ..regression import base_name, row_states
from .evidence import FitData, TrustLine, figures_of, first_case
from .held_out import Predict, held_out

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


def with_predictions(evidence: FitData, predict: Predict) -> FitData:
    """The same with what the fit of other blocks or recordings predicts; and with the prior, and
    the held-out error of its links: all else is fitted to the others.
    """
    line, by_others = held_out(evidence, predict)
    evidence = replace(evidence, held_out=line, by_others=by_others)
    problem, system = evidence.problem, evidence.observed.system
    values, source = base_prior(problem.model, problem.base)
    if not values or not evidence.robot.gain_known:
        return evidence
    evidence = replace(evidence, prior=values, prior_source=source)
    if line is None or line.level == "not made" or evidence.gains:
        return evidence
    known, free = _known_and_free(evidence)

    def with_links(*estimates: Estimate, by_recording: bool) -> Array:
        betas = (known + one.values_of(system.names) for one in estimates)
        whole = (replace(evidence.estimate, names=system.names, beta=beta) for beta in betas)
        return predict(*whole, by_recording=by_recording)

    rest, Z = replace(system, Y=system.Y - system.W @ known), evidence.Z[:, free]
    rows = replace(evidence.observed, system=rest.with_columns(free), Z=Z)
    with suppress(NoFitError):
        others = instrumental_variables(rows.system, Z, evidence.estimate.weights)
        line, _ = held_out(replace(evidence, observed=rows, estimate=others), with_links)
        evidence = replace(evidence, prior_error_percent=line.value if line else None)
    return evidence


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
    told = np.flatnonzero(explained > MIN_EXPLAINED)
    low, high = factor[told] - half[told], factor[told] + half[told]
    outside = told[(high < MIN_FACTOR) | (low > MAX_FACTOR)]
    unlike = ((needed > MIN_LEFT) & (explained < MIN_ALIKE)).any()
    cause = _cause(evidence) if len(outside) or unlike else ""
    values, everywhere = np.sort(factor[outside if len(outside) else told]), len(told) > 1
    everywhere &= len(outside) == len(told)
    between = " to ".join(dict.fromkeys(f"{x:.2g}" for x in [*values[:1], *values[-1:]]))
    text = f"torques are {between} times what {links} need"
    torques = ", ".join(f"torque of {names[j]} is {factor[j]:.2g} times" for j in outside)
    off = text if everywhere else f"{torques} what {links} need"
    spread = everywhere and values[-1] > max(MAX_SPREAD * values[0], 0.0)
    return first_case(
        "prior",
        (cause, "caution", f"{cause}? {links} then need the recorded torques", cause),
        (not len(told), "ok", f"no torque is like that of {links}"),
        (not len(outside), "ok", text),
        (spread, "cannot tell", f"the prior is off everywhere: {text}"),
        (True, "caution", f"{off}: drive_gain, ratio, unit, or the prior?", off),
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
    names = [joint.name for joint in evidence.robot.joints]
    base, same, (at, *motion) = problem.base, np.eye(len(names)), row_states(problem)
    beta = np.array([evidence.prior.get(name, 0.0) for name in base.names])
    beta += payload.values(evidence.estimate) * base.links if payload else 0.0
    links = direct_model(problem.model, base.standard_parameters(beta)).torques_of_links
    recorded, counts = evidence.observed.tau[at], evidence.observed.share[at] > 0
    as_recorded = links(*motion)

    def left(of_motion: Array, of_torque: Array) -> float:
        q, dq, ddq = (x @ of_motion for x in motion)
        tau = recorded @ of_torque
        rigid = as_recorded if of_motion is same else links(q, dq, ddq)
        moves = (counts @ np.abs(of_motion) > 0).T[..., None]
        others = np.stack([ddq.T, dq.T, np.sign(dq.T), np.ones_like(q.T)], axis=2)
        others, both = np.linalg.qr(others * moves)[0], np.stack([(tau - rigid).T, tau.T], axis=2)
        both = both * moves
        share, whole = ((both - others @ (others.swapaxes(1, 2) @ both)) ** 2).sum(axis=1).T
        return float(np.log(np.clip(share / (whole + 1e-300), MIN_LEFT, 1.0)).sum())

    found = [(left(same, same) - MIN_CAUSE, "")]
    for a, b in combinations(range(len(names)), 2):
        order, pair = same.copy(), f"of joints {names[a]} and {names[b]} exchanged"
        order[[a, b]] = same[[b, a]]
        found.append((left(same, order), f"recorded efforts {pair}"))
        found.append((left(order, same), f"recorded positions {pair}"))
    for own, of in [*zip(same, names, strict=True), (np.ones(len(names)), "all joints")]:
        for text, factor in UNITS.items():
            found.append((left(same + np.diag((factor - 1) * own), same), text.format(of)))
    return min(found)[1]
