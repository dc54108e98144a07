"""Whether estimated parameters are physical: M > 0 along the trajectory, no negative
friction or rotor inertia.

No method ensures that: an effort or a position of the wrong sign fits equally well, with negative
inertias and friction. Two half-widths of the 95 % interval below zero are not chance. M is tested
along single directions v: v'M(q)v is linear in beta, g(q, v)'beta with the variance g'Cg, C = D R D
with the formula's correlations R and the intervals' deviations D. Directions are each joint alone
and the eigenvector of the lowest eigenvalue, at each pose; for joints that share motors also the
speeds of their viscous friction and the corners of their Coulomb friction (`model.requirements`).
If friction has more terms than Fv and Fc, their sum is tested, not each sign: friction must not
drive a joint at a recorded speed. A stricter test is the distance of the nearest parameters whose
links have positive density. `fit --consistent` and `export` use the same requirements.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np

from .. import estimation
from ..arrays import Array, Bools
from ..errors import NoFitError
from ..model import friction_power, nearest_consistent, requirements
from ..regression import friction_states, recorded_power
from ..report import Level
from .efforts import sign_may_be_wrong
from .evidence import LEVELS, FitData, TrustLine, first_case
from .words import WORDS

MAX_HALF_WIDTHS = 2.0  # below zero; beyond, it is not chance
CHANCE_HALF_WIDTHS = 1.4  # the same, that one of twenty parameters exceeds in 5 % of clean fits
MIN_HALF_WIDTH = 1e-300  # avoids division by zero
MIN_RESIDUAL_RATIO = 0.9  # of the models without and with gravity; below, a caution
CONSISTENT_LEVEL = 0.001  # of the chi-squared test
FAR = 3.0  # times its limit
Finding = tuple[Level, str, str]  # with what is wrong in a few words, if that is known
Check = Callable[[str], tuple[str, str]]  # by a joint's name, what to check of it, and the words


def physical_test(evidence: FitData) -> TrustLine:
    """Whether the parameters are physical; each finding names the joint to check.

    Ordinary least squares weights all rows equally, so its deviations hide wrong signs of joints
    with small torques: weighted least squares is tested as well.
    """
    check = cache(partial(_check_of, evidence))
    found, lowest = _findings(evidence, check)
    found += _gravity_findings(evidence)
    if evidence.method == "ols" and all(level != "do not use" for level, *_ in found):
        weighted = estimation.weighted_least_squares(system := evidence.observed.system)
        within = estimation.intervals_of(system, weighted)
        again, _ = _findings(replace(evidence, estimate=weighted, intervals=within), check)
        found += [
            (x, f"by weighted least squares {text}", y) for x, text, y in again if x == LEVELS[0]
        ]
    found.sort(key=lambda finding: LEVELS.index(finding[0]))
    text = "; ".join(text for _, text, _ in found) or (
        f"M is positive on the trajectory (lowest eigenvalue {lowest:.3g}), no friction or rotor "
        "inertia is below zero"
    )
    level, _, finding = found[0] if found else ("ok", "", "")
    return TrustLine("physical", level, text, lowest, finding)


def _check_of(evidence: FitData, joint: str) -> tuple[str, str]:
    """What to check of a joint: its sign, unless the torque error is larger with it turned."""
    if sign_may_be_wrong(evidence, joint):
        check = f": check the sign of effort and position of joint {joint}"
        return check, WORDS["wrong sign"].format(joints=joint)
    return (
        f": check friction, rotor and zero of joint {joint}; its signs fit better than turned",
        "",
    )


def _findings(evidence: FitData, check: Check) -> tuple[list[Finding], float]:
    """Physically impossible values of the estimate, and the lowest eigenvalue
    of M on the trajectory.
    """
    idm, base, names = evidence.problem.model, evidence.problem.base, evidence.names
    # by recording the base parameters (b, e) in the estimate
    own = [np.array(arm.names)[:, None] == evidence.estimate.names for arm in evidence.arms]
    driving = _driving_findings(evidence, own, check)
    findings, lowest = _inertia_findings(evidence, np.any(own, axis=0), check)
    findings += driving
    apart, by_base = any("@" in name for name in evidence.estimate.names), np.linalg.pinv(base.K)
    required = requirements(idm, shaped=False)
    # by joint and kind: half-widths, and a text
    beyond = dict[tuple[int, str], tuple[float, str]]()
    for k in range(len(names) if apart else 1):
        for matrix, first, of in required:
            # of base parameters, which do not separate rotors regrouped with links
            G = matrix @ by_base
            separate, G = np.allclose(G @ base.K, matrix, atol=1e-9), G @ own[k]
            if separate and G.any():
                far, value, half, *_ = _worst(G, evidence)
                text = f"{of}{f' in {names[k]}' * apart} = {value:.4g} ± {half:.2g} {first.unit}"
                if far > 1:
                    key = first.joint, first.kind
                    beyond[key] = max((far, text), beyond.get(key, (far, text)))
    for joint in sorted({joint for joint, _ in beyond}):
        kinds = [one for (j, _), one in beyond.items() if j == joint]
        # One of many parameters exceeds its interval now and then; two of one joint hardly ever do.
        far = np.inf if len(kinds) > 1 else kinds[0][0]
        text = f"below zero: {', '.join(text for _, text in kinds)}"
        if far > CHANCE_HALF_WIDTHS:
            findings.append(_finding(far, text, check(idm.robot.joints[joint].name)))
    return findings, lowest


def _finding(far: float, text: str, check: tuple[str, str], otherwise: str = "") -> Finding:
    """Of a value that is so many half-widths below zero."""
    if far > MAX_HALF_WIDTHS:
        return "do not use", text + check[0], check[1]
    return "caution", text + (otherwise or check[0]), ""


def _worst(
    G: Array, evidence: FitData
) -> tuple[float, float, float, Array, tuple[np.intp, ...], float]:
    """Of the matrices G beta, G (..., d, d, b), v'(G beta)v that is most half-widths below zero of
    the directions v (d,) tried: how many, that, its half-width, v, and where; their lowest
    eigenvalue.
    """
    found, M = evidence.intervals, G @ evidence.estimate.beta
    values, vectors = np.linalg.eigh(0.5 * (M + M.swapaxes(-1, -2)))
    alone = np.broadcast_to(np.eye(M.shape[-1]), M.shape)
    v = np.concatenate([alone, vectors[..., None, :, 0]], axis=-2)
    g = np.einsum("...di,...ijb,...dj->...db", v, G, v, optimize=True)
    variance = ((g @ found.covariance) * g).sum(axis=-1)
    value, half = g @ evidence.estimate.beta, found.reach * np.sqrt(np.maximum(variance, 0.0))
    far = -value / np.maximum(half, MIN_HALF_WIDTH)
    at = np.unravel_index(far.argmax(), far.shape)
    return far[at], value[at], half[at], v[at], at, float(values.min())


def _driving_findings(evidence: FitData, arms: Sequence[Bools], check: Check) -> list[Finding]:
    """Whether friction of further terms would drive a joint, or joints that share
    motors, at recorded speeds.

    A single term does not decide: root friction may be negative if viscous friction
    compensates for it. Constant offsets are not friction. A recording's own parameters are
    tested at its own speeds.
    """
    idm, columns, each = evidence.problem.model, evidence.problem.base.columns, list[Array]()
    for problem, of_arm in zip(evidence.problems, arms, strict=True):
        if (states := friction_states(problem, of_arm @ evidence.estimate.beta)) is not None:
            G = friction_power(idm, columns, *states) @ of_arm
            j = np.abs(states[0]).argmax(axis=1)[:, None]
            each.append(np.c_[j, np.take_along_axis(states[0], j, axis=1), G])
    no_power = np.zeros((0, 2 + len(evidence.estimate.names)))
    findings, power = list[Finding](), np.concatenate([*each, no_power])
    power = power[np.lexsort(power[:, 1::-1].T)]
    for j in np.unique(power[:, 0]).astype(int):
        own, joint = power[power[:, 0] == j], idm.robot.joints[j]
        far, value, half, _, at, _ = _worst(own[:, None, None, 2:], evidence)
        if far > 1:
            level, text, of_sign = _finding(
                far,
                f"friction would drive joint {joint.name} at {own[at[0], 1]:.3g} "
                f"{joint.position_unit}/s: {value:.3g} ± {half:.2g} {idm.robot.effort_units[j]} "
                "against its motion",
                check(joint.name),
            )
            findings.append((level, f"{text}, or leave terms out", of_sign))
    return findings


def _inertia_findings(evidence: FitData, own: Bools, check: Check) -> tuple[list[Finding], float]:
    """A finding if M is not positive at all poses (P, n), and the lowest eigenvalue."""
    q = np.concatenate([problem.poses for problem in evidence.problems])
    idm, columns = evidence.problem.model, evidence.problem.base.columns
    # M e_j = IDM(q, 0, e_j) - IDM(q, 0, 0), linear in beta: (n + 1, P, n, e) of 0 and of each joint
    n = q.shape[1]
    still, ddq = np.zeros(((n + 1) * len(q), n)), np.eye(n + 1, n, -1).repeat(len(q), axis=0)
    W = idm.regressor(still + np.tile(q, (n + 1, 1)), still, ddq)[..., columns] @ own
    rest, *alone = W.reshape(n + 1, len(q), n, -1)
    G = np.stack(alone, axis=2) - rest[:, :, None]  # (P, n, n, e)
    far, value, half, v, _, least = _worst(G, evidence)
    if least > 0:
        return [], least
    joint = idm.robot.joints[int(np.abs(v).argmax())].name
    finding = _finding(
        far,
        f"the inertia matrix is not positive on the trajectory (lowest eigenvalue {least:.3g}; "
        f"{value:.3g} ± {half:.2g} about joint {joint})",
        check(joint),
        ", which may be noise; before simulating run fit --consistent",
    )
    return [finding], least


def _gravity_findings(evidence: FitData) -> list[Finding]:
    """Whether a model without gravity fits better, as for compensated efforts, unless axes are
    vertical.
    """
    base, rows, weighs = evidence.problem.base, evidence.observed, evidence.candidates.weighs
    if not len(weighs):
        return []
    # by unknown its column at rest
    same = np.array(base.names)[weighs][:, None] == np.array(rows.system.names)
    # The small R factor has the same column products as the rows.
    A = np.c_[rows.G, rows.system.W, rows.system.Y]
    A *= evidence.estimate.weights[rows.system.joint_of_row][:, None]
    G, W, Y = np.split(estimation.r_factor(A), [len(weighs), -1], axis=1)
    left = [100 * estimation.relative_residual(of, Y[:, 0]) for of in (W, W - G @ same)]
    finding: Finding = (
        "caution",
        f"the torques fit a model without gravity better: residual {left[1]:.3g} % against "
        f"{left[0]:.3g} %: the efforts lack the robot's weight, are no torques, or gravity_m_s2 is "
        "wrong",
        "",
    )
    return [finding] * (left[1] < MIN_RESIDUAL_RATIO * left[0])


def consistent_test(evidence: FitData) -> TrustLine | None:
    """Distance of the nearest consistent parameters: chi-squared, and the largest move in
    half-widths of the intervals.
    """
    problem, estimate, names = evidence.problem, evidence.estimate, evidence.arms[0].names
    if not problem.signals.robot.gain_known:
        text = "links cannot be compared: the drive gains are not known: state drive_gain"
        return TrustLine("consistent", "not made", text)
    # of own parameters those of one recording
    beta, of_fit = estimate.values_of(names), (estimate, evidence.intervals)
    covariance = estimation.covariance_of_all(names, *of_fit, evidence.least_squares)
    pairs = zip(evidence.problems, evidence.arms, strict=True)
    try:
        power = recorded_power([one for one, arm in pairs if arm.names == names], beta)
        nearest = nearest_consistent(problem.model, problem.base, beta, covariance, power)
    except NoFitError as error:
        return TrustLine("consistent", "cannot tell", error.args[0])
    moves = np.abs(nearest.deviations) / evidence.intervals.reach
    bound = estimation.chi_squared_quantile(CONSISTENT_LEVEL, len(names))
    text = (
        f"the nearest physical robot is at chi² = {nearest.chi_squared:.3g} ({len(names)} "
        f"parameters), {names[int(moves.argmax())]} moved by {moves.max():.2g} half-widths of its "
        "interval"
    )
    return first_case(
        "consistent",
        (
            nearest.chi_squared > bound,
            "caution",
            f"{text}, above {bound:.3g}, the limit of chance: check signs and units of efforts and "
            "positions, and frames",
        ),
        (True, "ok", text),
        value=nearest.chi_squared,
        far=nearest.chi_squared > FAR * bound,
    )
