"""Drive gains and payloads: what identified gains look like when something is
wrong, and what they assume.
"""

from collections.abc import Iterator

import numpy as np

from ..arrays import Array
from ..estimation import by_rows_alone, differs, intervals_of
from ..report import Assumed, Level
from .fit_data import FitData
from .lines import Figure, TrustLine

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
    name, robot, names = "gains", evidence.problem.robot, evidence.estimate.names
    motors = [m for m, motor in enumerate(robot.motors) if f"K:{motor.name}" in evidence.gains]
    half = 100 * evidence.intervals.half[[names.index(f"K:{robot.motors[m].name}") for m in motors]]
    K, labels = robot.gain[motors], [robot.motors[m].name for m in motors]
    described = np.array([np.nan if (g := robot.motors[m].gain) is None else g for m in motors])
    beside = zip(labels, K, half, np.where(np.isfinite(described), described, K), strict=True)
    figures = tuple(
        Figure(name=n, value=k, half_width=abs(k) * h / 100, expected=d) for n, k, h, d in beside
    )
    unsure = [f"{n} ±{h:.2g} %" for n, h in zip(labels, half, strict=True) if h >= MAX_HALF_PERCENT]
    worst = float(half.max())

    def line(level: Level, text: str, finding: str = "") -> TrustLine:
        return TrustLine(
            name,
            level,
            text,
            worst,
            finding=finding,
            figures=figures,
            unit="N m per unit of effort",
        )

    if (K < 0).all() and half.min() <= MAX_USABLE_PERCENT:
        return line(
            "do not use",
            "all drive gains are negative: the recordings are exchanged, the payload belongs "
            "to another",
            "recordings exchanged",
        )
    wrong = [
        n for n, k, h in zip(labels, K, half, strict=True) if k < 0 and h <= MAX_USABLE_PERCENT
    ]
    if wrong and (half[K <= 0] <= MAX_USABLE_PERCENT).all():
        finding = f"wrong sign of {' and '.join(wrong)}"
        return line(
            "do not use",
            f"{finding}: its drive gain is negative, others are positive: check the sign of "
            "its effort and of its position",
            finding,
        )
    if (K <= 0).any() or half.min() > MAX_USABLE_PERCENT:
        why = ", ".join(unsure) or "one is negative"
        return line(
            "do not use",
            f"no drive gain is usable ({why}): check which recording has the payload",
            "drive gains not determined",
        )
    if len(unsure) == len(motors):
        return line(
            "caution",
            f"no drive gain is known to {MAX_HALF_PERCENT:g} % ({', '.join(unsure)}): use a "
            "heavier payload",
            "drive gains not determined",
        )
    if (
        common := _common_factor(
            (K / described)[(half < MAX_HALF_PERCENT) & np.isfinite(described)]
        )
    ) is not None:
        text = f"drive gains are {common[0]:.3g} times those described (median), which scatter by "
        text += f"{100 * common[1]:.2g} %: check the payload's mass, or peak against rms"
        return line("caution", text, "drive gains off by one factor")
    text = f"known to {half.min():.2g} to {worst:.2g} %"
    text += f"; not determined: {', '.join(unsure)}" if unsure else ""
    ratios = np.abs(np.diag(robot.R))[motors]
    if any(
        (np.abs(np.abs(K * by) - 1) < 0.01 * MAX_OFF_ONE_PERCENT).all()
        for by in (np.ones(len(K)), ratios)
    ):
        text += "; all are 1 N m per unit: the recorded effort is a torque already"
    return line("ok", text)


def _common_factor(factors: Array) -> tuple[float, float] | None:
    """Median of factors (m,) and their scatter, by robust deviations of logarithms; None if
    there is no common factor.
    """
    if len(factors) < 2:
        return None
    of = np.log(factors)
    scatter = 1.4826 * float(np.median(np.abs(of - np.median(of))))
    limit = np.clip(MAX_SCATTERS * scatter, np.log(LEAST_FACTOR), np.log(SURE_FACTOR))
    off = abs(float(np.median(of)))
    of_median = scatter * np.sqrt(0.5 * np.pi / len(of))  # its deviation
    return (
        (float(np.exp(np.median(of))), scatter)
        if off > max(limit, MAX_SCATTERS * of_median)
        else None
    )


def centre_of_mass_test(evidence: FitData) -> TrustLine | None:
    """How far the centre of mass by the recordings alone is from the stated one; the
    line of the worst payload.
    """
    names, lines = evidence.estimate.names, list[TrustLine]()
    for one in dict.fromkeys(arm.payload for arm in evidence.arms):
        stated = {name: of for name, of in one.stated.items() if name in names} if one else {}
        if not one or not stated or not one.payload.mass_kg:
            continue
        alone = by_rows_alone(evidence.estimate, evidence.W, evidence.Y)
        found, at = (
            intervals_of(evidence.observed.system, alone),
            [names.index(name) for name in stated],
        )
        value, half = np.array(list(stated.values())).T
        off, C = alone.beta[at] - value, found.covariance[np.ix_(at, at)]
        mm = 1e3 / one.payload.mass_kg
        far, along = mm * float(np.linalg.norm(off)), off / max(float(np.linalg.norm(off)), 1e-300)
        width = mm * found.reach * float(np.sqrt(along @ C @ along))
        beyond = differs(off, C + np.diag((half / found.reach) ** 2), found.freedom)
        text = f"centre of mass by the data {far:.2g} ± {width:.2g} mm from the stated one"
        if beyond:
            text += (
                f", beyond its ± {1e3 * one.payload.center_half_width_m:g} mm, and not used: "
                "check centre, frame and mass"
            )
        figures = (Figure(name="distance", value=far, half_width=width, expected=0.0),)
        level: Level = "caution" if beyond else "ok"
        finding = "centre of mass differs" if beyond else ""
        lines.append(
            TrustLine(
                "centre of mass", level, text, far, finding=finding, figures=figures, unit="mm"
            )
        )
    return max(lines, key=lambda line: (line.level == "caution", line.value or 0.0), default=None)


def payload_assumptions(evidence: FitData) -> Iterator[Assumed]:
    """Mass and frame of the payloads, which no test covers."""
    found = dict.fromkeys(arm.payload for arm in evidence.arms)
    joint = evidence.problem.signals.robot.joints[-1].name
    for one in found:
        if one is None:
            continue
        whys = list[str]()
        if one.payload.mass_kg is not None:
            scaled = "drive gains and all parameters scale with its mass"
            whys.append(scaled if evidence.gains else "it is taken off the arm")
        if None not in found:
            whys.append(
                "no recording is without payload: the parameters include what is not stated of the "
                "lightest"
            )
        if whys:
            yield Assumed("payload", one.payload.describe(joint), "; ".join(whys))
