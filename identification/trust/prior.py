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
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import NoFitError
from ..estimation import MIN_COLUMN_NORM, Estimate, instrumental_variables, intervals_of
from ..model import base_prior, direct_model
from ..regression import base_name, row_states
from .fit_data import FitData
from .held_out import Predict, held_out_parts, held_out_test
from .lines import Figure, TrustLine

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


def with_prior(evidence: FitData, predict: Predict) -> FitData:
    """The same with the prior and the held-out error of its links: all else is fitted to the other
    blocks, or recordings.
    """
    problem, system = evidence.problem, evidence.observed.system
    values, source = base_prior(problem.model, problem.base)
    if not values or not problem.signals.robot.gain_known:
        return evidence
    evidence = replace(evidence, prior=values, prior_source=source)
    known, free = _known_and_free(evidence)

    def with_links(*estimates: Estimate, by_recording: bool = False) -> Array:
        whole = (
            replace(one, names=system.names, beta=known + one.values_of(system.names))
            for one in estimates
        )
        return predict(*whole, by_recording=by_recording)

    with suppress(NoFitError):
        if evidence.held_out and not evidence.gains:
            rest = replace(system, Y=system.Y - system.W @ known).with_columns(free)
            Z = (system.W if evidence.Z is None else evidence.Z)[:, free]
            others = instrumental_variables(rest, Z, evidence.estimate.weights)
            of_rest = replace(
                evidence, observed=replace(evidence.observed, system=rest, Z=Z), estimate=others
            )
            line = held_out_test(replace(of_rest, held_out=held_out_parts(of_rest, with_links)))
            return replace(evidence, prior_error_percent=line.value)
    return evidence


def prior_test(evidence: FitData) -> TrustLine | None:
    """By joint its torque over that of the prior's links; joints that seem exchanged or in other
    units. Never `do not use`.
    """
    if not evidence.prior or evidence.gains:
        return None
    links, names = (
        f"the {evidence.prior_source}'s links",
        [one.name for one in evidence.problem.signals.robot.joints],
    )
    factor, half, explained, needed = zip(
        *(_factor(evidence, j) for j in range(len(names))), strict=True
    )
    told = [j for j, share in enumerate(explained) if share > MIN_EXPLAINED]
    outside = [
        j for j in told if factor[j] + half[j] < MIN_FACTOR or factor[j] - half[j] > MAX_FACTOR
    ]
    figures = (
        Figure(name=names[j], value=factor[j], half_width=half[j], expected=1.0) for j in told
    )
    line = TrustLine("prior", "ok", f"no torque is like that of {links}", figures=tuple(figures))
    unlike = any(
        share > MIN_LEFT and by < MIN_ALIKE for share, by in zip(needed, explained, strict=True)
    )
    if (outside or unlike) and (cause := _cause(evidence)):
        return replace(
            line,
            level="caution",
            text=f"{cause}? {links} then need the recorded torques",
            finding=cause,
        )
    if not told:
        return line
    values, everywhere = sorted(factor[j] for j in outside or told), len(outside) == len(told) > 1
    between = " to ".join(dict.fromkeys(f"{x:.2g}" for x in (values[0], values[-1])))
    text = f"torques are {between} times what {links} need"
    if not outside:
        return replace(line, text=text)
    if everywhere and values[-1] > max(MAX_SPREAD * values[0], 0.0):
        return replace(line, level="cannot tell", text=f"the prior is off everywhere: {text}")
    each = ", ".join(f"torque of {names[j]} is {factor[j]:.2g} times" for j in outside)
    text = text if everywhere else f"{each} what {links} need"
    return replace(
        line, level="caution", text=f"{text}: drive_gain, ratio, unit, or the prior?", finding=text
    )


def _known_and_free(evidence: FitData) -> tuple[Array, NDArray[np.intp]]:
    """(p,) values of the system's parameters by the prior, zero where it has none; places of those
    that are fitted instead.
    """
    names = evidence.observed.system.names
    of_prior = [evidence.prior.get(base_name(name)) for name in names]
    free = [
        i
        for i, value in enumerate(of_prior)
        if value is None and names[i] in evidence.estimate.names
    ]
    return np.array([value or 0.0 for value in of_prior]), np.array(free, dtype=np.intp)


def _factor(evidence: FitData, j: int) -> tuple[float, float, float, float]:
    """The factor of joint j and half its 95 % interval, and shares of the square of its torque,
    both without what is not of links: what the prior's links explain with the factor, and their
    own. Zeros where it is undetermined.
    """
    system, (known, free) = evidence.observed.system, _known_and_free(evidence)
    own = system.joint_of_row == j
    W, Y = (x[own] for x in system.weighted(np.ones(len(system.rows))))
    acts = np.linalg.norm(W, axis=0) > MIN_COLUMN_NORM * np.linalg.norm(system.W, axis=0)
    columns = np.c_[known, np.eye(len(known))[:, free[acts[free]]]]
    J, Z = W @ columns, (W if evidence.Z is None else evidence.Z[own]) @ columns
    both = np.c_[Y, J[:, 0]]
    whole, needed = ((both - J[:, 1:] @ np.linalg.lstsq(J[:, 1:], both)[0]) ** 2).sum(
        axis=0
    ) + 1e-300
    alone = replace(
        system.part(own),
        W=J,
        joint_of_row=np.zeros(own.sum(), dtype=np.intp),
        names=tuple(map(str, range(J.shape[1]))),
        rows=system.rows[[j]],
    )
    with suppress(NoFitError):
        found = instrumental_variables(alone, Z, np.ones(1))
        half = float(intervals_of(alone, found).half[0])
        return float(found.beta[0]), half, 1 - found.residual_norm**2 / whole, needed / whole
    return 0.0, 0.0, 0.0, 0.0


def _cause(evidence: FitData) -> str:
    """What, corrected, lets the prior's links explain the torques far better, in some 300 rows
    of the first recording.
    """
    problem, payload, states = (
        evidence.problem,
        evidence.arms[0].payload,
        row_states(evidence.problem, always=True),
    )
    assert states is not None
    beta = np.array([evidence.prior.get(name, 0.0) for name in problem.base.names])
    beta += payload.values(evidence.estimate) * problem.base.links if payload else 0.0
    links = direct_model(problem.model, problem.base.standard_parameters(beta))
    names = [joint.name for joint in problem.signals.robot.joints]
    same = np.eye(len(names))
    recorded, counts = (x[states.rows] for x in (evidence.observed.tau, evidence.observed.counts))
    as_recorded = links.torques_of_links(states.q, states.dq, states.ddq)

    def left(of_motion: Array, of_torque: Array) -> float:
        q, dq, ddq = (x @ of_motion for x in (states.q, states.dq, states.ddq))
        tau, rigid = (
            recorded @ of_torque,
            as_recorded if of_motion is same else links.torques_of_links(q, dq, ddq),
        )
        moves = (counts @ np.abs(of_motion) > 0).T[..., None]
        others = np.linalg.qr(
            np.stack([ddq.T, dq.T, np.sign(dq.T), np.ones_like(q.T)], axis=2) * moves
        )[0]
        both = np.stack([(tau - rigid).T, tau.T], axis=2) * moves
        share, whole = ((both - others @ (others.swapaxes(1, 2) @ both)) ** 2).sum(axis=1).T
        return float(np.log(np.clip(share / (whole + 1e-300), MIN_LEFT, 1.0)).sum())

    found = [(left(same, same) - MIN_CAUSE, "")]
    for a, b in combinations(range(len(names)), 2):
        order, pair = same.copy(), f"of joints {names[a]} and {names[b]} exchanged"
        order[[a, b]] = same[[b, a]]
        found += [
            (left(same, order), f"recorded efforts {pair}"),
            (left(order, same), f"recorded positions {pair}"),
        ]
    for text, factor in UNITS.items():
        for own, of in [*zip(same, names, strict=True), (np.ones(len(names)), "all joints")]:
            found.append((left(same + np.diag((factor - 1) * own), same), text.format(of)))
    return min(found)[1]
