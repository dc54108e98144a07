"""Drive gains and payloads: what identified gains look like when something is
wrong, and what they assume.
"""

from collections.abc import Iterator

import numpy as np

from ..arrays import Array
from ..estimation import by_rows_alone, differs, intervals_of
from ..report import Assumed
from .fit_data import FitData
from .lines import TrustLine, figures_of, first_case, worst_of

MAX_HALF_PERCENT = 10.0  # of a gain; with more it is not determined
MAX_USABLE_PERCENT = 50.0  # the same of the best gain; with more no gain is usable
MAX_SCATTERS = 3.0  # of the catalogue's own: by more the described gains are all off by one factor
# no smaller one is reported; larger where 3 deviations of the median show it
LEAST_FACTOR, SURE_FACTOR = 1.1, 1.6
MAX_OFF_ONE_PERCENT = 2.0  # of gains that are 1 N m/A, by themselves or with their ratio


def gains_test(evidence: FitData) -> TrustLine | None:
    """Whether identified gains are positive, determined, and not all off by one factor beyond the
    catalogue's own scatter.
    """
    if not evidence.gains:
        return None
    robot, of = evidence.problem.robot, evidence.estimate.names
    motors = [m for m, motor in enumerate(robot.motors) if f"K:{motor.name}" in evidence.gains]
    names = [robot.motors[m].name for m in motors]
    at = [of.index(f"K:{name}") for name in names]
    half = 100 * evidence.intervals.half[at] / np.abs(evidence.estimate.beta[at])
    gains, K = [robot.motors[m].gain for m in motors], robot.gain[motors]
    described = np.array([np.nan if gain is None else gain for gain in gains])
    usable, expected = half <= MAX_USABLE_PERCENT, np.where(np.isnan(described), K, described)
    unsure = ", ".join(
        f"{n} ±{h:.2g} %" for n, h in zip(names, half, strict=True) if h >= MAX_HALF_PERCENT
    )
    wrong = f"wrong sign of {' and '.join(np.array(names)[(K < 0) & usable])}"
    common = _common_factor((K / described)[(half < MAX_HALF_PERCENT) & np.isfinite(described)])
    torques = any(
        (np.abs(np.abs(K * by) - 1) < 0.01 * MAX_OFF_ONE_PERCENT).all()
        for by in (np.ones(len(K)), np.abs(np.diag(robot.R))[motors])
    )
    return first_case(
        "gains",
        (
            (K < 0).all() and usable.any(),
            "do not use",
            "all drive gains are negative: the recordings are exchanged, the payload belongs to "
            "another",
            "recordings exchanged",
        ),
        (
            usable[K <= 0].all() and (K < 0).any(),
            "do not use",
            f"{wrong}: its drive gain is negative, others are positive: check the sign of its "
            "effort and of its position",
            wrong,
        ),
        (
            (K <= 0).any() or not usable.any(),
            "do not use",
            f"no drive gain is usable ({unsure or 'one is negative'}): check which recording has "
            "the payload",
            "drive gains not determined",
        ),
        (
            (half >= MAX_HALF_PERCENT).all(),
            "caution",
            f"no drive gain is known to {MAX_HALF_PERCENT:g} % ({unsure}): use a heavier payload",
            "drive gains not determined",
        ),
        (common, "caution", common, "drive gains off by one factor"),
        (
            True,
            "ok",
            f"known to {half.min():.2g} to {half.max():.2g} %"
            + f"; not determined: {unsure}" * bool(unsure)
            + "; all are 1 N m per unit: the recorded effort is a torque already" * torques,
        ),
        value=float(half.max()),
        figures=figures_of(names, K, np.abs(K) * half / 100, expected),
        unit="N m per unit of effort",
    )


def _common_factor(factors: Array) -> str:
    """What is wrong where factors (m,) have a common one, beyond robust deviations of their
    logarithms.
    """
    of = np.log(np.maximum(np.abs(factors), 1e-300))
    if len(of) < 2:
        return ""
    scatter, off = 1.4826 * np.median(np.abs(of - np.median(of))), np.median(of)
    limit = np.clip(MAX_SCATTERS * scatter, np.log(LEAST_FACTOR), np.log(SURE_FACTOR))
    of_median = scatter * np.sqrt(0.5 * np.pi / len(of))  # its deviation
    return (
        f"drive gains are {np.exp(off):.3g} times those described (median), which scatter by "
        f"{100 * scatter:.2g} %: check the payload's mass, or peak against rms"
    ) * bool(abs(off) > max(limit, MAX_SCATTERS * of_median))


def centre_of_mass_test(evidence: FitData) -> TrustLine | None:
    """How far the centre of mass by the recordings alone is from the stated one; the
    line of the worst payload.
    """
    names, lines = evidence.estimate.names, list[TrustLine | None]()
    for one in dict.fromkeys(arm.payload for arm in evidence.arms):
        stated = {name: of for name, of in one.stated.items() if name in names} if one else {}
        if not one or not stated or not one.payload.mass_kg:
            continue
        alone = by_rows_alone(evidence.estimate, evidence.W, evidence.Y)
        found, at = intervals_of(evidence.observed.system, alone), list(map(names.index, stated))
        value, half = np.array(list(stated.values())).T
        off, C = alone.beta[at] - value, found.covariance[np.ix_(at, at)]
        size, mm = float(np.linalg.norm(off)), 1e3 / one.payload.mass_kg
        far, along = mm * size, off / max(size, 1e-300)
        width = mm * found.reach * float(np.sqrt(along @ C @ along))
        text = f"centre of mass by the data {far:.2g} ± {width:.2g} mm from the stated one"
        lines.append(
            first_case(
                "centre of mass",
                (
                    differs(off, C + np.diag((half / found.reach) ** 2), found.freedom),
                    "caution",
                    f"{text}, beyond its ± {1e3 * one.payload.center_half_width_m:g} mm, and not "
                    "used: check centre, frame and mass",
                    "centre of mass differs",
                ),
                (True, "ok", text),
                value=far,
                figures=figures_of(["distance"], [far], [width], [0.0]),
                unit="mm",
            )
        )
    return worst_of(lines)


def payload_assumptions(evidence: FitData) -> Iterator[Assumed]:
    """Mass and frame of the payloads, which no test covers."""
    found = dict.fromkeys(arm.payload for arm in evidence.arms)
    joint = evidence.robot.joints[-1].name
    for one in found:
        whys = (
            (
                one and one.payload.mass_kg is not None and evidence.gains,
                "drive gains and all parameters scale with its mass",
            ),
            (
                one and one.payload.mass_kg is not None and not evidence.gains,
                "it is taken off the arm",
            ),
            (
                None not in found,
                "no recording is without payload: the parameters include what is not stated of "
                "the lightest",
            ),
        )
        if one and (why := "; ".join(text for holds, text in whys if holds)):
            yield Assumed("payload", one.payload.describe(joint), why)
