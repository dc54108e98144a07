"""Tests of the rows: whether joints move in them, which are lost or slow, and outliers."""

from itertools import pairwise

import numpy as np

from .. import estimation
from ..arrays import Array
from ..data import position_steps
from ..regression import Problem, standing_joints
from ..report import TrustResult
from .evidence import Case, TrustInputs, Words

MAX_MISSING_PERCENT = 0.1  # of the moving rows
MAX_HELD_RATIO = 0.3  # of missing or repeated rows over held rows
MAX_COARSE_PERCENT = 0.4  # of a joint's moving steps that are double or zero: a slow encoder
MAX_ROBUST_DEVIATIONS = 6.0  # above: an outlier
MAX_END_DEVIATIONS = 30.0  # of a row at an end; above: caution
MAX_END_RATIO = 2.0  # of the largest deviation at an end over the largest elsewhere
END_ROWS = 5  # rows at each end that a bad edge affects


def motion_test(evidence: TrustInputs) -> TrustResult | None:
    """Test for joints that do not move in any recording.

    Friction of creeping differs from that of motion.
    """
    speed, robot = np.abs(evidence.observed.speed).max(axis=0), evidence.robot
    names = ", ".join(standing_joints(speed, robot.joints))
    return MOTION.judge({"standing": names}, names=names)


MOTION = Words(
    test="motion",
    place=100,
    by=motion_test,
    of_data=True,
    advice="Record a motion of this joint.",
    detects="Joints that do not move in any recording",
    limit="`caution`: there is one; its friction values do not apply in motion",
    cases={
        "standing": Case(
            "caution",
            "joint {names} does not move, so its friction values do not apply in motion",
            "Record a motion of this joint, or do not use these values.",
            "{names} does not move",
        )
    },
)


def rows_test(e: TrustInputs) -> TrustResult | None:
    """Find the recording with most missing or repeated rows.

    Without one, find those with rows that were not measured, or one whose encoders are slower than
    the log.
    """
    counted, coarse = zip(
        *(
            position_steps(of.with_samples().signals.q[of.settings.start : of.settings.stop])
            for of in e.problems
        ),
        strict=True,
    )
    places = [f"{name}: " if len(e.names) > 1 else "" for name in e.names]
    shares = np.array([100 * of[:3] / max(of[3], 1) for of in counted])
    least = np.maximum(MAX_MISSING_PERCENT, MAX_HELD_RATIO * shares[:, 2:])
    surplus = shares[:, :2] * (shares[:, :2] > least)
    k = int(surplus.sum(axis=1).argmax())
    finding = " and ".join(
        ROWS.part("share", percent=x, what=what)
        for x, what in zip(surplus[k], ("missing", "repeated"), strict=True)
        if x
    )
    notes = (
        place + note
        for place, one, steps, held in zip(places, e.problems, coarse, shares[:, 2], strict=True)
        if (note := one.signals.unmeasured or _slow_encoder(one, steps, float(held)))
    )
    return ROWS.judge(
        {"lost": finding, "note": (note := next(notes, ""))},
        value=float(surplus[k].sum()) if finding else None,
        where=places[k],
        found=finding,
        note=note,
    )


ROWS = Words(
    test="rows",
    place=110,
    by=rows_test,
    of_data=True,
    advice="Record timestamps or a row counter, and record again.",
    detects="Missing or repeated samples: position steps that are double or zero, with a robust "
    "z-score above 10",
    limit="`caution`: more than 0.1 % of the rows in motion. `passed`: [unmeasured "
    "rows](#rows-and-filters) have zero weight, or the encoder is slower than the log",
    cases={
        "lost": Case(
            "caution",
            "{where}{found} (position steps that are double or zero)",
            "Record timestamps or a row counter ([time] in map.toml), or record again.",
            "{found}",
        ),
        "note": Case("ok", "{note}"),
    },
    parts={
        "share": "{percent:.2g} % of the rows {what}",
        "slow": "the log is faster than the encoder{joints}: {percent:.2g} % of the steps are "
        "double or zero",
    },
)


def _slow_encoder(problem: Problem, coarse: Array, held: float) -> str:
    """Return the note on positions that stay for one row and jump in the next.

    Such rows are not missing rows.
    """
    percent = 100 * coarse[:, 1:] / np.maximum(coarse[:, :1], 1)
    both = (percent.min(axis=1) > MAX_MISSING_PERCENT) & (percent.sum(axis=1) > MAX_COARSE_PERCENT)
    slow = zip(problem.signals.robot.joints, both, strict=True)
    if names := ", ".join(joint.name for joint, it in slow if it):
        names, held = f" of joint {names}", float(percent.sum(axis=1).max())
    elif held <= MAX_MISSING_PERCENT:
        return ""
    return ROWS.part("slow", joints=names, percent=held)


def ends_test(evidence: TrustInputs) -> TrustResult | None:
    """Test for outliers of rows in motion, especially at the ends.

    Outliers have a robust z-score above 6.
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
    return ENDS.judge(
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


ENDS = Words(
    test="outliers",
    place=190,
    by=ends_test,
    advice='Set `edges = "smooth"`, or cut the ends off.',
    detects="Outliers of rows in motion at an end of a recording, as a bad edge causes",
    limit="`caution`: a robust z-score at an end is above 30, and above twice the largest "
    "elsewhere",
    cases={
        "edge": Case(
            "caution",
            "{outliers}; joint {joint}: largest {elsewhere:.3g}, at the ends {value:.3g}",
            'Set edges = "smooth", or cut the ends off (cut_start_samples, cut_end_samples).',
        ),
        "ok": Case("ok", "{outliers}"),
    },
    parts={
        "outliers": "{count} outliers in {rows} rows in motion; largest robust z-score "
        "{middle:.3g} (limit {limit:g}), at the ends {ends:.3g}"
    },
)
