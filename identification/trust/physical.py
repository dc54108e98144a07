"""Tests of the physical plausibility of estimated parameters.

They test that M > 0 along the trajectory, and that friction and rotor inertia are not negative.

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

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product

import numpy as np
from msgspec import structs

from .. import estimation
from ..arrays import Array, Bools
from ..errors import NoFitError
from ..model import friction_power, nearest_consistent, requirements
from ..regression import friction_states, recorded_power
from ..report import TrustResult, is_own
from .efforts import sign_may_be_wrong
from .evidence import LEVELS, Case, TrustInputs, Words

MAX_HALF_WIDTHS = 2.0  # below zero; beyond, it is not chance
CHANCE_HALF_WIDTHS = 1.4  # the same, that one of twenty parameters exceeds in 5 % of clean fits
MIN_HALF_WIDTH = 1e-300  # avoids division by zero
MIN_RESIDUAL_RATIO = 0.9  # of the models without and with gravity; below, a caution
CONSISTENT_LEVEL = 0.001  # of the chi-squared test
FAR = 3.0  # times its limit
Check = Callable[[str], bool]  # whether a sign may be wrong, by a joint's name


def physical_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether the parameters are physically plausible; each finding names the joint to check.

    Ordinary least squares weights all rows equally, so its standard errors hide wrong signs of
    joints with small torques. Weighted least squares is therefore tested as well.
    """
    check = cache(partial(sign_may_be_wrong, evidence))
    found, lowest = _findings(evidence, check)
    found += filter(None, [_finding_of_gravity(evidence)])
    if evidence.method == "ols" and all(line.level != LEVELS[0] for line in found):
        weighted = estimation.weighted_least_squares(system := evidence.observed.system)
        again = replace(
            evidence,
            estimate=weighted,
            intervals=estimation.intervals_of(system, weighted),
        )
        found += [
            structs.replace(line, text=PHYSICAL.part("weighted", text=line.text))
            for line in _findings(again, check)[0]
            if line.level == LEVELS[0]
        ]
    if not found:
        return PHYSICAL.judge({"ok": True}, value=lowest)
    found.sort(key=lambda line: LEVELS.index(line.level))
    texts, advice = (
        [*dict.fromkeys(x)] for x in zip(*((x.text, x.advice) for x in found), strict=True)
    )
    return structs.replace(
        found[0], text="; ".join(texts), advice=" ".join(filter(None, advice)), value=lowest
    )


_SIGN = "Check the sign of effort and position of joint {joint}{or_terms}."
_TERMS = (
    "Check friction, rotor and zero of joint {joint}; its signs fit better than reversed{or_terms}."
)


PHYSICAL = Words(
    test="physical plausibility",
    place=70,
    by=physical_test,
    advice="Check what the finding names, the driver's definition of effort, and `gravity_m_s2`.",
    detects="An inertia matrix M that is not positive, negative friction or rotor inertia, and "
    "torques that a model without gravity fits better. Joints that share motors are tested "
    "together (Fc5 + Fcm6 of the TX40); further friction terms by their power at recorded speeds",
    limit="`do not use`: a value is more than two half-widths below zero; or the parameters are "
    "far from a physically consistent model and a second indication confirms this, such as a "
    "reversed effort or a held-out error above 20 %. `caution`: M is less far below zero, or "
    "friction by more than 1.4 half-widths",
    cases={
        "wrong sign": Case(
            "do not use", "{what}", _SIGN, "{joint}: effort or position has the wrong sign"
        ),
        "impossible": Case("do not use", "{what}", _TERMS),
        "noise": Case(
            "caution", "{what}, which may be noise", "Fit with --consistent before simulating."
        ),
        "perhaps wrong sign": Case("caution", "{what}", _SIGN),
        "doubtful": Case("caution", "{what}", _TERMS),
        "no weight": Case(
            "caution",
            "a model without gravity fits the torques better: residual {without:.3g} % against "
            "{residual:.3g} %",
            "Check that the efforts are torques and contain the robot's weight, and gravity_m_s2.",
        ),
        "ok": Case(
            "ok",
            "M is positive on the trajectory (lowest eigenvalue {value:.3g}), and no friction or "
            "rotor inertia is negative",
        ),
    },
    parts={
        "drives": "friction would drive joint {joint} at {speed:.3g} {length}/s: "
        "{lowest:.3g} ± {half:.2g} {effort} against its motion",
        "inertia": "the inertia matrix is not positive on the trajectory (lowest eigenvalue "
        "{least:.3g}; {lowest:.3g} ± {half:.2g} about joint {joint})",
        "below": "negative: {each}",
        "or_terms": ", or leave terms out",
        "weighted": "by weighted least squares {text}",
        "far": "{text}. The parameters are far from a physically consistent model, and {witness}",
    },
)


def _findings(evidence: TrustInputs, check: Check) -> tuple[list[TrustResult], float]:
    """Return the physically impossible values of the estimate, and an eigenvalue of M.

    The eigenvalue is the lowest on the trajectory.
    """
    # Per-recording parameters are tested at the speeds of their own recording, so select them by
    # recording, (b, e).
    own = [np.array(arm.names)[:, None] == evidence.estimate.names for arm in evidence.arms]
    of_inertia, lowest = _finding_of_inertia(evidence, np.any(own, axis=0), check)
    found = (
        of_inertia,
        *_driving_findings(evidence, own, check),
        *_findings_below_zero(evidence, own, check),
    )
    return [*filter(None, found)], lowest


def _findings_below_zero(
    evidence: TrustInputs, own: Sequence[Bools], check: Check
) -> Iterator[TrustResult | None]:
    """Return findings on joints with negative friction or rotor inertia."""
    idm, base, names = evidence.problem.model, evidence.problem.base, evidence.names
    apart, by_base = any(map(is_own, evidence.estimate.names)), np.linalg.pinv(base.K)
    # Two findings of one joint confirm each other, so collect them by joint and kind.
    beyond = dict[tuple[int, str], tuple[float, str]]()
    for k, (matrix, first, of) in product(
        range(len(names) if apart else 1), requirements(idm, shaped=False)
    ):
        # Base parameters do not separate rotors that are regrouped with links, so test the sums.
        G = matrix @ by_base
        if not np.allclose(G @ base.K, matrix, atol=1e-9) or not (G := G @ own[k]).any():
            continue
        far, value, half, *_ = _worst(G, evidence)
        text = f"{of}{f' in {names[k]}' * apart} = {value:.4g} ± {half:.2g} {first.unit}"
        if far > 1:
            key = first.joint, first.kind
            beyond[key] = max((far, text), beyond.get(key, (far, text)))
    for joint in sorted({joint for joint, _ in beyond}):
        kinds = [one for (j, _), one in beyond.items() if j == joint]
        # One of many parameters exceeds its interval now and then; two of one joint hardly ever do.
        far = np.inf if len(kinds) > 1 else kinds[0][0]
        text = PHYSICAL.part("below", each=", ".join(text for _, text in kinds))
        if far > CHANCE_HALF_WIDTHS:
            yield _finding(far, text, idm.robot.joints[joint].name, check)


def _finding(
    far: float, what: str, joint: str, check: Check, *, noise: bool = False, terms: bool = False
) -> TrustResult | None:
    """Return the finding on a value that is `far` half-widths below zero.

    `noise`: below how many half-widths it may be noise. `terms`: friction terms that may be the
    cause.
    """
    sign, certain = check(joint), far > MAX_HALF_WIDTHS
    return PHYSICAL.judge(
        {
            "wrong sign": certain and sign,
            "impossible": certain,
            "noise": noise,
            "perhaps wrong sign": sign,
            "doubtful": True,
        },
        what=what,
        joint=joint,
        or_terms=terms,
    )


def _worst(
    G: Array, evidence: TrustInputs
) -> tuple[float, float, float, Array, tuple[np.intp, ...], float]:
    """Find the matrix G beta, G (..., d, d, b), whose v'(G beta)v is most half-widths below zero.

    Return how many half-widths, the value, its half-width, the direction v (d,), its index, and the
    lowest eigenvalue of the matrices.
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


def _driving_findings(
    evidence: TrustInputs, arms: Sequence[Bools], check: Check
) -> Iterator[TrustResult | None]:
    """Test whether further friction terms would drive a joint at recorded speeds.

    The test also covers joints that share motors. A single term does not decide: square-root
    friction may be negative if viscous friction compensates for it. Constant offsets are not
    friction. Per-recording parameters are tested at the speeds of their recording.
    """
    idm, columns, each = evidence.problem.model, evidence.problem.base.columns, list[Array]()
    for problem, of_arm in zip(evidence.problems, arms, strict=True):
        if (states := friction_states(problem, of_arm @ evidence.estimate.beta)) is not None:
            G = friction_power(idm, columns, *states) @ of_arm
            j = np.abs(states[0]).argmax(axis=1)[:, None]
            each.append(np.c_[j, np.take_along_axis(states[0], j, axis=1), G])
    power = np.concatenate([*each, np.zeros((0, 2 + len(evidence.estimate.names)))])
    power = power[np.lexsort(power[:, 1::-1].T)]
    for j in np.unique(power[:, 0]).astype(int):
        own, joint = power[power[:, 0] == j], idm.robot.joints[j]
        far, value, half, _, at, _ = _worst(own[:, None, None, 2:], evidence)
        if far > 1:
            text = PHYSICAL.part(
                "drives",
                joint=joint.name,
                speed=own[at[0], 1],
                length=joint.position_unit,
                lowest=value,
                half=half,
                effort=idm.robot.effort_units[j],
            )
            yield _finding(far, text, joint.name, check, terms=True)


def _finding_of_inertia(
    evidence: TrustInputs, own: Bools, check: Check
) -> tuple[TrustResult | None, float]:
    """Return a finding if M is not positive at all poses (P, n), and the lowest eigenvalue."""
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
        return None, least
    joint = idm.robot.joints[int(np.abs(v).argmax())].name
    text = PHYSICAL.part("inertia", least=least, lowest=value, half=half, joint=joint)
    return _finding(far, text, joint, check, noise=True), least


def _finding_of_gravity(evidence: TrustInputs) -> TrustResult | None:
    """Test whether a model without gravity fits better, as for compensated efforts.

    Robots whose axes are vertical are not tested.
    """
    base, rows, weighs = evidence.problem.base, evidence.observed, evidence.candidates.weighs
    if not len(weighs):
        return None
    # At rest only gravity acts, so the columns of the links' weight are all that is needed.
    same = np.array(base.names)[weighs][:, None] == np.array(rows.system.names)
    # The small R factor has the same column products as the rows.
    A = np.c_[rows.G, rows.system.W, rows.system.Y]
    A *= evidence.estimate.weights[rows.system.joint_of_row][:, None]
    G, W, Y = np.split(estimation.r_factor(A), [len(weighs), -1], axis=1)
    left = [100 * estimation.relative_residual(of, Y[:, 0]) for of in (W, W - G @ same)]
    return PHYSICAL.judge(
        {"no weight": left[1] < MIN_RESIDUAL_RATIO * left[0]}, without=left[1], residual=left[0]
    )


def consistent_test(evidence: TrustInputs) -> TrustResult | None:
    """Return the distance to the nearest physically consistent parameters.

    The distance is chi², and the largest change in half-widths.
    """
    problem, estimate, names = evidence.problem, evidence.estimate, evidence.arms[0].names
    if not problem.signals.robot.gain_known:
        return CONSISTENT.judge({"unknown gains": True})
    # Per-recording parameters have several values; those of one recording make a consistent robot.
    beta, of_fit = estimate.values_of(names), (estimate, evidence.intervals)
    covariance = estimation.covariance_of_all(names, *of_fit, evidence.least_squares)
    pairs = zip(evidence.problems, evidence.arms, strict=True)
    try:
        power = recorded_power([one for one, arm in pairs if arm.names == names], beta)
        nearest = nearest_consistent(problem.model, problem.base, beta, covariance, power)
    except NoFitError as error:
        return CONSISTENT.judge({"none near": True}, error=str(error))
    moves = np.abs(nearest.deviations) / evidence.intervals.reach
    bound = estimation.chi_squared_quantile(CONSISTENT_LEVEL, len(names))
    distance = nearest.chi_squared
    return CONSISTENT.judge(
        {"far": distance > FAR * bound, "apart": distance > bound, "ok": True},
        value=distance,
        bound=bound,
        count=len(names),
        name=names[int(moves.argmax())],
        moved=moves.max(),
    )


_APART = Case(
    "caution",
    "{distance}, above the 0.1 % limit of {bound:.3g}",
    "Check signs and units of efforts and positions, and frames.",
)


CONSISTENT = Words(
    test="physically consistent",
    place=180,
    by=consistent_test,
    advice="Check signs, units and frames.",
    detects="The distance chi² to the nearest physically consistent model",
    limit="`caution`: further than noise explains (0.1 % level)",
    cases={
        "unknown gains": Case(
            "skipped",
            "links cannot be compared, because the drive gains are not known",
            "Set drive_gain.",
        ),
        "none near": Case("inconclusive", "{error}"),
        "far": _APART,
        "apart": _APART,
        "ok": Case("ok", "{distance}"),
    },
    parts={
        "distance": "the nearest physically consistent model is at chi² = {value:.3g} ({count} "
        "parameters), {name} changes by {moved:.2g} half-widths of its interval"
    },
)
