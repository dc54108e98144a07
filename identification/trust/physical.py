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

import numpy as np
from numpy.typing import NDArray

from .. import estimation
from ..arrays import Array
from ..errors import NoFitError
from ..model import InverseModel, friction_power, nearest_consistent, poses_of, requirements
from ..regression import base_name, base_places, friction_states, recorded_power, row_states
from ..report import Level
from .fit_data import FitData, covariance_of_all
from .lines import LEVELS, TrustLine

MAX_HALF_WIDTHS = 2.0  # below zero; beyond, it is not chance
MIN_HALF_WIDTH = 1e-300  # avoids division by zero
MIN_ARM_M = 1e-9  # of a weight about an axis
MIN_RESIDUAL_RATIO = 0.9  # of the models without and with gravity; below, a caution
CONSISTENT_LEVEL = 0.001  # of the chi-squared test
Finding = tuple[Level, str]


def physical_test(evidence: FitData) -> TrustLine:
    """Whether the parameters are physical; each finding names the joint to check.

    Ordinary least squares weights all rows equally, so its deviations hide wrong signs of joints
    with small torques: weighted least squares is tested as well.
    """
    base = evidence.base
    found, lowest = _findings(evidence, evidence.estimate.part(base), evidence.intervals.part(base))
    found += _gravity_findings(evidence)
    if evidence.method == "ols" and all(level != "do not use" for level, _ in found):
        system, base = evidence.observed.system, base_places(evidence.observed.system.names)
        weighted = estimation.weighted_least_squares(system)
        within = estimation.intervals_of(system, weighted).part(base)
        severe, _ = _findings(evidence, weighted.part(base), within)
        found += [
            (level, f"by weighted least squares {text}")
            for level, text in severe
            if level == "do not use"
        ]
    if not found:
        text = (
            f"M is positive on the trajectory (lowest eigenvalue {lowest:.3g}), no friction or "
            "rotor inertia is below zero"
        )
        return TrustLine("physical", "ok", text, lowest)
    found.sort(key=lambda finding: LEVELS.index(finding[0]))
    return TrustLine("physical", found[0][0], "; ".join(text for _, text in found), lowest)


def _findings(
    evidence: FitData, estimate: estimation.Estimate, found: estimation.Intervals
) -> tuple[list[Finding], float]:
    """Physically impossible values of an estimate, and the lowest eigenvalue
    of M on the trajectory.
    """
    idm, base = evidence.problem.model, evidence.problem.base
    indices = np.array([base.names.index(base_name(name)) for name in estimate.names])
    poses = np.concatenate([poses_of(problem.used_positions()) for problem in evidence.problems])
    findings, lowest = _inertia_findings(idm, base.columns[indices], estimate.beta, found, poses)
    findings += _driving_findings(evidence, base.columns[indices], estimate, found)
    own = any("@" in name for name in estimate.names)
    # by joint and kind: half-widths, and a text
    beyond: dict[int, dict[str, tuple[float, str]]] = {}
    by_base = np.linalg.pinv(base.K)
    for arm, recording in list(zip(evidence.arms, evidence.names, strict=True))[
        : None if own else 1
    ]:
        of_part = np.array([name in arm.names for name in estimate.names])
        for matrix, first, of in requirements(idm, shaped=False):
            # of base parameters, which do not separate rotors regrouped with links
            G = matrix @ by_base
            if (
                not np.allclose(G @ base.K, matrix, atol=1e-9)
                or not (G := G[..., indices] * of_part).any()
            ):
                continue
            _, value, half = _along_directions(G, estimate.beta, found)
            worst = int(np.argmin(value / np.maximum(half, MIN_HALF_WIDTH)))
            name = of + (f" in {recording}" if own else "")
            text = f"{name} = {value[worst]:.4g} ± {half[worst]:.2g} {first.unit}"
            furthest = (float(-value[worst] / max(half[worst], MIN_HALF_WIDTH)), text)
            if furthest[0] > 1:
                of_joint = beyond.setdefault(first.joint, {})
                of_joint[first.kind] = max(furthest, of_joint.get(first.kind, furthest))
    for joint, kinds in sorted(beyond.items()):
        # One of many parameters exceeds its interval now and then; two of one joint hardly ever do.
        severe = len(kinds) > 1 or any(far > MAX_HALF_WIDTHS for far, _ in kinds.values())
        text = (
            f"below zero: {', '.join(text for _, text in kinds.values())}: "
            f"{_advice(idm.robot.joints[joint].name)}"
        )
        findings.append(("do not use" if severe else "caution", text))
    return findings, lowest


def _half(g: Array, found: estimation.Intervals) -> Array:
    """Half-widths (k,) of g beta, of rows g (k, b)."""
    return np.asarray(
        found.reach
        * np.sqrt(np.maximum(np.einsum("...b,bc,...c->...", g, found.covariance, g), 0.0))
    )


def _along_directions(
    G: Array, beta: Array, found: estimation.Intervals
) -> tuple[Array, Array, Array]:
    """Directions v (..., d + 1, d) tried of the matrices G beta, G (..., d, d, b), v'(G
    beta)v, and its half-widths.
    """
    M = G @ beta
    vectors = np.linalg.eigh(0.5 * (M + M.swapaxes(-1, -2)))[1]
    v = np.concatenate(
        [np.broadcast_to(np.eye(M.shape[-1]), M.shape), vectors[..., None, :, 0]], axis=-2
    )
    g = np.einsum("...di,...ijb,...dj->...db", v, G, v)
    return v, g @ beta, _half(g, found)


def _driving_findings(
    evidence: FitData,
    columns: NDArray[np.intp],
    estimate: estimation.Estimate,
    found: estimation.Intervals,
) -> list[Finding]:
    """Whether friction of further terms would drive a joint, or joints that share
    motors, at recorded speeds.

    A single term does not decide: root friction may be negative if viscous friction
    compensates for it. Constant offsets are not friction. A recording's own parameters are
    tested at its own speeds.
    """
    idm, robot = evidence.problem.model, evidence.problem.model.robot
    # by joint: in half-widths, speed, power, half-width
    worst: dict[int, tuple[float, float, float, float]] = {}
    for problem, arm in zip(evidence.problems, evidence.arms, strict=True):
        of_part = np.array([name in arm.names for name in estimate.names])
        if (states := row_states(problem)) is None:
            continue
        dq, load = friction_states(problem, estimate.values_of(arm.names), states)
        G = friction_power(idm, columns, dq, load) * of_part
        for g, v in zip(G, dq, strict=True):
            j, power, half = (
                int(np.abs(v).argmax()),
                float(g @ estimate.beta),
                float(_half(g, found)),
            )
            one = (power / max(half, MIN_HALF_WIDTH), v[j], power, half)
            worst[j] = min(one, worst.get(j, one))
    findings = list[Finding]()
    for j, (beyond, speed, power, half) in sorted(worst.items()):
        if beyond < -1:
            joint, unit = robot.joints[j], robot.effort_units[j]
            text = (
                f"friction would drive joint {joint.name} at {speed:.3g} "
                f"{joint.position_unit}/s: {power:.3g} ± {half:.2g} "
            )
            text += f"{unit} against its motion: {_advice(joint.name)}, or leave terms out"
            findings.append(("do not use" if beyond < -MAX_HALF_WIDTHS else "caution", text))
    return findings


def _advice(name: str) -> str:
    return f"check the sign of effort and position of joint {name}"


def _inertia_findings(
    idm: InverseModel, columns: NDArray[np.intp], beta: Array, found: estimation.Intervals, q: Array
) -> tuple[list[Finding], float]:
    """A finding if M is not positive at all poses (P, n), and the lowest eigenvalue."""
    zero = np.zeros_like(q)
    # M e_j = IDM(q, 0, e_j) - IDM(q, 0, 0), linear in beta
    at_rest = idm.regressor(q, zero, zero)[:, :, columns]
    alone = [idm.regressor(q, zero, zero + e)[:, :, columns] for e in np.eye(q.shape[1])]
    G = np.stack([one - at_rest for one in alone], axis=2)  # (P, n, n, b)
    M = G @ beta
    if (least := float(np.linalg.eigvalsh(0.5 * (M + M.transpose(0, 2, 1)))[:, 0].min())) > 0:
        return [], least
    directions, lowest, half = _along_directions(G, beta, found)
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = np.unravel_index(
            int(np.nanargmin(np.where(lowest < 0, lowest / half, 0.0))), lowest.shape
        )
    joint = idm.robot.joints[int(np.abs(directions[worst]).argmax())].name
    finding = f"the inertia matrix is not positive on the trajectory (lowest eigenvalue {least:.3g}"
    finding += f"; {lowest[worst]:.3g} ± {half[worst]:.2g} about joint {joint})"
    if (lowest < -MAX_HALF_WIDTHS * half).any():
        return [("do not use", f"{finding}: {_advice(joint)}")], least
    return [
        ("caution", f"{finding}, which may be noise; before simulating run fit --consistent")
    ], least


def _gravity_findings(evidence: FitData) -> list[Finding]:
    """Whether a model without gravity fits better, as for compensated efforts, unless axes are
    vertical.
    """
    problem, idm, terms = evidence.problem, evidence.problem.model, evidence.candidates[0]
    poses = np.concatenate([poses_of(problem.used_positions()) for problem in evidence.problems])
    at_rest = idm.regressor(poses, 0 * poses, 0 * poses)[:, :, problem.base.columns[terms.weighs]]
    if np.abs(at_rest).max(initial=0.0) <= MIN_ARM_M * np.linalg.norm(
        problem.signals.robot.gravity
    ):
        return []
    system = evidence.observed.system
    gravity = dict(
        zip(
            (problem.base.names[place] for place in terms.weighs),
            evidence.observed.C[:, terms.at_rest].T,
            strict=True,
        )
    )
    weighs = [i for i, name in enumerate(system.names) if name in gravity]
    G = np.array([gravity[system.names[i]] for i in weighs]).T
    # The small R factor has the same column products as the rows.
    R = estimation.r_factor(np.c_[np.c_[system.W, G] * evidence.weight[:, None], evidence.Y])
    W, left = R[:, : len(system.names)].copy(), list[float]()
    for weight in (0.0, R[:, len(system.names) : -1]):
        W[:, weighs] -= weight
        size = np.linalg.norm(W, axis=0)
        A = W / np.where(size > 0, size, 1.0)
        rho = R[:, -1] - A @ np.linalg.lstsq(A, R[:, -1], rcond=1e-9)[0]
        left.append(100 * float(np.linalg.norm(rho) / np.linalg.norm(evidence.Y)))
    if left[1] >= MIN_RESIDUAL_RATIO * left[0]:
        return []
    text = (
        f"the torques fit a model without gravity better: residual {left[1]:.3g} % against "
        f"{left[0]:.3g} %: "
    )
    text += "the efforts lack the robot's weight, are no torques, or gravity_m_s2 is wrong"
    return [("caution", text)]


def consistent_test(evidence: FitData) -> TrustLine:
    """Distance of the nearest consistent parameters: chi-squared, and the largest move in
    half-widths of the intervals.
    """
    problem, estimate = evidence.problem, evidence.estimate
    if not problem.signals.robot.gain_known:
        text = "links cannot be compared: the drive gains are not known: state drive_gain"
        return TrustLine("consistent", "not made", text)
    all_names, names = evidence.observed.system.names, evidence.arms[0].names
    covariance = covariance_of_all(all_names, estimate, evidence.intervals, evidence.least_squares)
    # of own parameters those of one recording
    first = np.array([all_names.index(name) for name in names])
    moved = [
        problem
        for problem, arm in zip(evidence.problems, evidence.arms, strict=True)
        if arm.names == names
    ]
    beta = estimate.values_of(names)
    try:
        power = recorded_power(moved, beta)
        nearest = nearest_consistent(
            problem.model, problem.base, beta, covariance[np.ix_(first, first)], power
        )
    except NoFitError as error:
        return TrustLine("consistent", "cannot tell", error.args[0])
    moves = np.abs(nearest.deviations) / evidence.intervals.reach
    bound = estimation.chi_squared_quantile(CONSISTENT_LEVEL, len(names))
    text = (
        f"the nearest physical robot is at chi² = {nearest.chi_squared:.3g} ({len(names)} "
        "parameters), "
    )
    text += f"{names[int(moves.argmax())]} moved by {moves.max():.2g} half-widths of its interval"
    if nearest.chi_squared > bound:
        text += (
            f", above {bound:.3g}, the limit of chance: check signs and units of efforts and "
            "positions, and frames"
        )
        return TrustLine("consistent", "caution", text, nearest.chi_squared)
    return TrustLine("consistent", "ok", text, nearest.chi_squared)
