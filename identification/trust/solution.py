"""Tests of the solution: fixed point, instruments, parts of the rows.

Nothing is simulated again.
"""

from contextlib import suppress
from itertools import pairwise

import numpy as np

from .. import estimation
from ..arrays import Array
from ..data import position_steps
from ..errors import NoFitError
from ..model import JointTerm
from ..regression import Problem, standing_joints
from ..report import TrustLine
from .evidence import FitData, Part, judge, part_of

HALVES_LEVEL = 0.001  # of the Wald test
MIN_SQUARE_OF_HALF = 1e-10  # of a direction of Q in a half; below, it is undetermined
MAX_ROBUST_DEVIATIONS = 6.0  # above: an outlier
MAX_END_DEVIATIONS = 30.0  # of a row at an end; above: caution
MAX_END_RATIO = 2.0  # of the largest deviation at an end over the largest elsewhere
END_ROWS = 5  # rows at each end that a bad edge affects
# below, weak; above, the instruments are W itself
MIN_FIRST_STAGE_F, MAX_FIRST_STAGE_F = 10.0, 1e10
MAX_CONDITION = 50.0  # of scaled columns; 7 to 11 of motions of five sines
MAX_MISSING_PERCENT = 0.1  # of the moving rows
MAX_HELD_RATIO = 0.3  # of missing or repeated rows over held rows
MAX_COARSE_PERCENT = 0.4  # of a joint's moving steps that are double or zero: a slow encoder


def fixed_point_line(status: str, reason: str | None, *, gains: bool) -> TrustLine | None:
    """Whether the passes ended in a fixed point that the simulated robot confirms."""
    converged = status == "converged"
    return judge(
        "fixed point",
        {
            "none": not converged and status != "not_confirmed",
            "no simulation": not converged and gains,
            "not confirmed": not converged,
            "by reference": reason is not None,
            "confirmed": True,
        },
        why=reason if converged else f"status {status}: {reason}",
    )


def instruments_test(evidence: FitData) -> TrustLine | None:
    """Whether the instruments explain the regressor, and are more than the regressor itself."""
    if (F := evidence.first_stage_F) is None:
        return None
    return judge(
        "instruments",
        {"weak": F < MIN_FIRST_STAGE_F, "regressor": F > MAX_FIRST_STAGE_F, "ok": True},
        value=F,
        limit=MIN_FIRST_STAGE_F,
    )


def units_test(evidence: FitData) -> TrustLine | None:
    """Whether joints share parameters although their drive gains are not known: then the torques
    are in different units.
    """
    robot, rows = evidence.robot, evidence.observed.system
    size = np.stack(
        [np.linalg.norm(rows.W[rows.joint_of_row == j], axis=0) for j in range(robot.n)]
    )
    acts = size > estimation.MIN_COLUMN_NORM * np.linalg.norm(size, axis=0)
    shared = [rows.names[i] for i in np.flatnonzero(acts.sum(axis=0) > 1)]
    return judge(
        "units",
        {"known": robot.gain_known or robot.n == 1, "shared": shared, "apart": True},
        shared=", ".join(shared[:5]),
    )


def essential_test(evidence: FitData) -> TrustLine | None:
    """Whether the interval of some inertia is narrower than its value."""
    base, idm, names = (
        evidence.problem.base,
        evidence.problem.model,
        [x.names for x in evidence.arms],
    )
    rows = np.isin(names, evidence.essential).any(axis=0)
    sources = [idm.sources[c] for c in np.flatnonzero(base.K[rows].any(axis=0))]
    inertia = any(not isinstance(x, JointTerm) or x.kind == "rotor" for x in sources)
    return judge(
        "essential",
        {"ok": inertia, "no inertia": True},
        essential=len(evidence.essential),
        count=len(np.unique(names)),
    )


def excitation_test(evidence: FitData) -> TrustLine | None:
    """Whether the motion excites all combinations of the essential parameters: a single sine moves
    joints as well, but always together.
    """
    names = np.array(evidence.estimate.names)
    essential = np.isin(names, evidence.essential)
    if not essential.any():
        return None
    W = np.linalg.qr(evidence.W[:, essential], mode="r")
    _, values, directions = np.linalg.svd(W / np.maximum(np.linalg.norm(W, axis=0), 1e-300))
    condition = float(values[0] / max(values[-1], 1e-300))
    worst = names[essential][np.argsort(-np.abs(directions[-1]))[:3]]
    return judge(
        "excitation",
        {"hardly": condition > MAX_CONDITION, "ok": True},
        value=condition,
        limit=MAX_CONDITION,
        names=", ".join(worst),
    )


def ends_test(evidence: FitData) -> TrustLine | None:
    """Outliers of moving rows, beyond 6 robust deviations of their joint,
    especially at the ends.
    """
    rho = np.abs(evidence.observed.tau - evidence.predicted)
    used = (evidence.observed.share > 0) & estimation.are_moving(evidence.observed.speed)
    each = zip(rho.T, used.T, strict=True)
    scale = np.array([1.4826 * np.median(x[at]) if at.any() else np.inf for x, at in each])
    size = np.where(used, rho / np.where(scale > 0, scale, np.inf), 0.0)
    at_end = np.zeros(len(size), dtype=bool)
    for start, stop in pairwise(evidence.ends):
        at_end[start : start + END_ROWS] = at_end[stop - END_ROWS : stop] = True
    ends, middle = size[at_end].max(axis=0), size[~at_end].max(axis=0)
    worst = int((ends / np.maximum(middle, MAX_ROBUST_DEVIATIONS)).argmax())
    at_ends, elsewhere = float(ends[worst]), float(middle[worst])
    return judge(
        "ends",
        {"edge": at_ends > max(MAX_END_DEVIATIONS, MAX_END_RATIO * elsewhere), "ok": True},
        value=at_ends,
        count=(size > MAX_ROBUST_DEVIATIONS).sum(),
        rows=used.sum(),
        middle=middle.max(),
        limit=MAX_ROBUST_DEVIATIONS,
        ends=ends.max(),
        joint=evidence.robot.joints[worst].name,
        elsewhere=elsewhere,
    )


def halves_test(evidence: FitData) -> TrustLine | None:
    """Whether both halves of the recording give the same parameters: a Wald test, with the
    cosines of both as freedom.
    """
    T, cuts = len(evidence.observed.tau), evidence.ends[1:-1]
    # recordings are not cut
    cut = int(cuts[np.abs(cuts - T / 2).argmin()]) if len(cuts) else round(T / 2)
    half = evidence.spans(2)[0] if evidence.gains else evidence.between(0, cut)
    first, second = (_solve_part(evidence, part) for part in (half, ~half))
    if first is None or second is None:
        return judge("halves", {"undetermined": True})
    C = first.covariance + second.covariance
    sigma, b = np.sqrt(np.diag(C)), len(C)
    if not (sigma > 0).all():
        return judge("halves", {"exact": True})
    u = 0.5 * (second.low + second.high - first.low - first.high) / sigma
    values, vectors = np.linalg.eigh(C / np.outer(sigma, sigma))
    wald = float((((vectors.T @ u) ** 2) / np.maximum(values, 1e-12)).sum())
    p = estimation.f_tail(wald / b, b, first.freedom + second.freedom)
    return judge(
        "halves",
        {"differ": p < HALVES_LEVEL, "ok": True},
        value=wald,
        count=b,
        p=p,
        name=evidence.estimate.names[np.abs(u).argmax()],
        most=np.abs(u).max(),
    )


def _solve_part(evidence: FitData, part: Part) -> estimation.Intervals | None:
    """Intervals of the parameters by a span of time; None where they are undetermined."""
    rows = part[evidence.observed.system.span]
    values = np.linalg.eigvalsh(evidence.estimate.Q[rows].T @ evidence.estimate.Q[rows])
    determined = values[0] > MIN_SQUARE_OF_HALF * values[-1]
    if not determined or evidence.count(part) <= 2 * len(values):
        return None
    system = evidence.observed.system.part(rows).with_columns(evidence.places)
    with suppress(NoFitError):
        Z = evidence.Z[np.ix_(rows, evidence.places)]
        own = estimation.instrumental_variables(system, Z, evidence.estimate.weights)
        return estimation.intervals_of(system, own, part)
    return None


def motion_test(evidence: FitData) -> TrustLine | None:
    """Joints that stand in all recordings; friction of creeping differs from that of motion."""
    speed, robot = np.abs(evidence.observed.speed).max(axis=0), evidence.robot
    names = ", ".join(standing_joints(speed, robot.joints))
    return judge("motion", {"standing": names}, names=names)


def rows_test(e: FitData) -> TrustLine | None:
    """The recording with most missing or repeated rows; else those with rows that nobody measured,
    or one whose encoders are slower than the log.
    """
    each = (
        position_steps(of.with_samples().signals.q[of.settings.start : of.settings.stop])
        for of in e.problems
    )
    counted, coarse = zip(*each, strict=True)
    places = [f"{name}: " if len(e.names) > 1 else "" for name in e.names]
    shares = np.array([100 * of[:3] / max(of[3], 1) for of in counted])
    least = np.maximum(MAX_MISSING_PERCENT, MAX_HELD_RATIO * shares[:, 2:])
    surplus = shares[:, :2] * (shares[:, :2] > least)
    k = int(surplus.sum(axis=1).argmax())
    finding = " and ".join(
        part_of("rows", "share", percent=x, what=what)
        for x, what in zip(surplus[k], ("missing", "repeated"), strict=True)
        if x
    )
    notes = (
        place + note
        for place, one, steps, held in zip(places, e.problems, coarse, shares[:, 2], strict=True)
        if (note := one.signals.unmeasured or _slow_encoder(one, steps, float(held)))
    )
    return judge(
        "rows",
        {"lost": finding, "note": (note := next(notes, ""))},
        value=float(surplus[k].sum()) if finding else None,
        where=places[k],
        found=finding,
        note=note,
    )


def _slow_encoder(problem: Problem, coarse: Array, held: float) -> str:
    """The note on positions that stand for one row and jump in the next,
    which are not missing rows.
    """
    percent = 100 * coarse[:, 1:] / np.maximum(coarse[:, :1], 1)
    both = (percent.min(axis=1) > MAX_MISSING_PERCENT) & (percent.sum(axis=1) > MAX_COARSE_PERCENT)
    slow = zip(problem.signals.robot.joints, both, strict=True)
    if names := ", ".join(joint.name for joint, it in slow if it):
        names, held = f" of joint {names}", float(percent.sum(axis=1).max())
    elif held <= MAX_MISSING_PERCENT:
        return ""
    return part_of("rows", "slow", joints=names, percent=held)
