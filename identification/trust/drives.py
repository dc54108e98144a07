"""Tests of the drives: the lag of their torque, their control law, their gains and what they carry.

The control law that is found in the recording does not depend on the robot's model, so its test
detects what a fit cannot: an effort of the wrong scale or sign, which scales every parameter and
fits equally well. Units are those of the recorded effort: the drive gain cancels and is not tested.
A delay of the reference belongs to the recording, not to the law: the simulated robot has it, and
nothing is judged by it.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from msgspec import structs

from ..arrays import Array
from ..control import MAX_LAW_PERCENT, FoundLaw
from ..estimation import by_rows_alone, differs, intervals_of
from ..regression import LAG_ORDERS, Lag, Problem
from ..report import Assumed, TrustLine, gain_name
from .evidence import LEVELS, FitData, figures_of, judge, part_of, worst_of
from .words import assume

MAX_DEVIATIONS_FROM_STATED = 4.0  # between the data and a lag that the user states
MAX_EARLY_SAMPLES = 0.75  # of a torque before its command, besides the interval
LAW = "control law"
MAX_GAIN_ERROR = 0.01  # beyond: caution
MAX_MIRRORED_PERCENT = 2.0  # residual of negative gains; below, the effort has the wrong sign
COMMON = 0.02  # spread of the gains' factors, for one scale of the effort
LETTERS = ("Kp", "Kd", "Ki")
MAX_HALF_PERCENT = 10.0  # of a gain; with more it is not determined
MAX_USABLE_PERCENT = 50.0  # the same of the best gain; with more no gain is usable
MAX_SCATTERS = 3.0  # of the catalogue's own: by more the described gains are all off by one factor
# no smaller one is reported; larger where 3 deviations of the median show it
LEAST_FACTOR, SURE_FACTOR = 1.1, 1.6
MAX_OFF_ONE_PERCENT = 2.0  # of gains that are 1 N m/A, by themselves or with their ratio


def lag_test(evidence: FitData) -> TrustLine | None:
    """Whether torque and motion are synchronous, or the cost of not knowing it; the
    line of the worst group.
    """
    return worst_of(_line_of_lag(evidence, lag) for lag in evidence.lags)


def _line_of_lag(evidence: FitData, lag: Lag) -> TrustLine | None:
    moved, name = _largest_move(evidence, lag)
    fs, prior, value_ms = 1 / lag.period_s, lag.prior or lag, 1e3 * lag.value_s
    late, half, sd_ms = lag.value_s * fs, lag.half_width_s * fs, 1e3 * lag.sd_s
    found, found_sd, _ = lag.found or (lag.value_s, 0.0, 0)
    delay, delay_half = (fs * x for x in lag.delay_s or (0.0, 0.0))
    lost = lag.found is None
    exogenous = all(one.signals.q_ref is not None for one in evidence.problems)
    unseen = assume(
        "lag",
        lag=f"{value_ms:.2g} ± {sd_ms:.2g} ms",
        cost=part_of("lag", "cost", moved=moved, name=name),
        stated=False,
    )
    return judge(
        "lag",
        {
            "contradicted": lag.stated
            and abs(found - lag.value_s) > MAX_DEVIATIONS_FROM_STATED * found_sd,
            "stated": lag.stated,
            "harmless": lost and moved <= 1,
            "not shown": lost and exogenous and evidence.candidates.simulated,
            "not measured": lost and exogenous,
            "assumed": lost,
            "impossible": delay < -MAX_EARLY_SAMPLES - delay_half,
            "ok": True,
        },
        value=late,
        figures=figures_of(["lag"], [late], [half], [prior.value_s * fs]),
        assumed=(unseen,) * (lost and not lag.stated and not exogenous),
        value_s=lag.value_s,
        found=found,
        found_half=found_sd * lag.reach,
        value_ms=value_ms,
        sd_ms=sd_ms,
        unknown=prior.source == "nothing",
        by_source=prior.source != "nothing",
        source=prior.source,
        moved=moved,
        name=name,
        size=abs(late),
        half=half,
        way="late" if late >= 0 else "early",
        rejected=lag.source == "data",
        prior=prior.value_s * fs,
        delayed=lag.delay_s is not None,
        delay=delay,
        delay_half=delay_half,
        whitened=0 < lag.order < LAG_ORDERS[0],
        order=lag.order,
        usual=LAG_ORDERS[0],
    )


def _largest_move(evidence: FitData, lag: Lag) -> tuple[float, str]:
    """The essential parameter that a deviation of the lag moves most, and how far, in half-widths
    without the lag.
    """
    rest = intervals_of(evidence.observed.system, evidence.estimate).sigma
    moved = np.divide(lag.moved, rest, out=np.zeros_like(rest), where=rest > 0)
    names = evidence.estimate.names
    counts = [i for i, name in enumerate(names) if name in evidence.essential] or range(len(names))
    worst = max(counts, key=lambda i: moved[i])
    return moved[worst], names[worst]


def control_law_line(
    problems: Sequence[Problem], laws: Sequence[FoundLaw | None]
) -> TrustLine | None:
    """Whether the described controllers give the recorded efforts: the line
    of the worst recording.
    """
    names = [problem.signals.recording for problem in problems]
    each = zip(map(law_line, problems, laws), names, strict=True)
    worst, name = min(
        ((line, name) for line, name in each if line is not None),
        key=lambda one: (
            LEVELS.index(one[0].level),
            -abs((1.0 if (x := one[0].value) is None else x) - 1.0),
        ),
    )
    if len(names) == 1:
        return worst
    reason = worst.text.removeprefix("not made: ")
    return structs.replace(
        worst, text=f"{'not made: ' if reason != worst.text else ''}{name}: {reason}"
    )


def law_line(problem: Problem, law: FoundLaw | None) -> TrustLine | None:
    """Return the line of a recording."""
    signals, controller = problem.signals, problem.signals.robot.controller
    unknown = {
        "no reference": signals.q_ref is None,
        "computed torque": controller.structure == "computed_torque",
        "short": law is None,
        "none found": law and law.described is None and law.reason is not None,
    }
    if law is None or any(unknown.values()):
        return judge(LAW, unknown, reason=law and law.reason)
    line = _line_of_law(law, [motor.name for motor in signals.robot.motors])
    if line is None or not controller.gravity_feedforward:
        return line
    return structs.replace(line, text=part_of(LAW, "fed", text=line.text))


def _line_of_law(found: FoundLaw, motors: list[str]) -> TrustLine | None:
    used, error = found.used, found.residual_percent
    delay_ms, structure = 1e3 * float(np.median(found.delay_s)), found.law.structure
    if found.described is None:
        alone = ", ".join(np.array(motors)[~found.clear])
        return judge(
            LAW,
            {"found": True},
            gains=_gains(found, 0),
            motor=motors[0],
            left=error.max(),
            alone=alone,
            unclear=bool(alone),
            structure=structure,
            delay_ms=delay_ms,
        )
    gains, described, half = found.gains[used], found.described[used], found.gains_half[used]
    factor, within = gains / described, half / described
    off = np.nan_to_num(np.abs(factor - 1) * (np.abs(factor - 1) > 2 * within))
    mirrored = (factor < 0).all(axis=0) & (error <= MAX_MIRRORED_PERCENT)
    beyond = np.maximum(off.max(axis=0) / MAX_GAIN_ERROR, error / MAX_LAW_PERCENT)
    j = int(np.argmax(np.maximum(beyond, 1e9 * mirrored)))
    if found.reason is not None and not mirrored[j] and (factor[:, j] < 0).any():
        return judge(LAW, {"another": True}, reason=found.reason, left=error[j])
    names = [f"{letter} {motor}" for letter in np.array(LETTERS)[used] for motor in motors]
    figures = figures_of(names, factor.flat, within.flat, np.ones(factor.size))
    return judge(
        LAW,
        {
            "sign": mirrored.any(),
            "rival": found.rival,
            "scale": beyond[j] > 1 and np.ptp(factor[:, j]) < COMMON,
            "off": beyond[j] > 1,
            "ok": True,
        },
        value=float(factor[int(np.argmax(off[:, j])), j]),
        figures=tuple(one for one in figures if np.isfinite(one[1])),
        motor=motors[j],
        gains=_gains(found, j),
        left=error[j],
        delay_ms=delay_ms,
        rival=found.rival,
        structure=structure,
    )


def _gains(found: FoundLaw, j: int) -> str:
    """The gains of a motor with their half-widths, and those described."""
    return ", ".join(
        f"{LETTERS[i]} {found.gains[i, j]:.5g} ± {found.gains_half[i, j]:.2g}"
        + ("" if found.described is None else f" of {found.described[i, j]:.5g}")
        for i in np.flatnonzero(found.used)
    )


def gains_test(evidence: FitData) -> TrustLine | None:
    """Whether identified gains are positive, determined, and not all off by one factor beyond the
    catalogue's own scatter.
    """
    if not evidence.gains:
        return None
    robot, of = evidence.problem.signals.robot, evidence.estimate.names
    motors = [m for m, motor in enumerate(robot.motors) if gain_name(motor.name) in evidence.gains]
    names = [robot.motors[m].name for m in motors]
    at = [of.index(gain_name(name)) for name in names]
    factor, gains = evidence.estimate.beta[at], [robot.motors[m].gain for m in motors]
    half = 100 * evidence.intervals.half[at] / np.abs(factor)
    described = np.array([np.nan if gain is None else gain for gain in gains])
    K = factor * np.nan_to_num(described, nan=1.0)
    usable, expected = half <= MAX_USABLE_PERCENT, np.where(np.isnan(described), K, described)
    unsure = ", ".join(
        f"{n} ±{h:.2g} %" for n, h in zip(names, half, strict=True) if h >= MAX_HALF_PERCENT
    )
    factor_of_all, scatter, is_common = _common_factor((K / described)[half < MAX_HALF_PERCENT])
    torques = any(
        (np.abs(np.abs(K * by) - 1) < 0.01 * MAX_OFF_ONE_PERCENT).all()
        for by in (np.ones(len(K)), np.abs(np.diag(robot.R))[motors])
    )
    return judge(
        "gains",
        {
            "all negative": (K < 0).all() and usable.any(),
            "negative": usable[K <= 0].all() and (K < 0).any(),
            "none usable": (K <= 0).any() or not usable.any(),
            "none determined": (half >= MAX_HALF_PERCENT).all(),
            "one factor": is_common,
            "ok": True,
        },
        value=float(half.max()),
        figures=figures_of(names, K, np.abs(K) * half / 100, expected),
        negative=" and ".join(np.array(names)[(K < 0) & usable]),
        unsure=unsure or "one is negative",
        some_unsure=bool(unsure),
        limit=MAX_HALF_PERCENT,
        factor=factor_of_all,
        scatter=100 * scatter,
        least=half.min(),
        torques=torques,
    )


def _common_factor(factors: Array) -> tuple[float, float, bool]:
    """Of factors (m,), nan where unknown, the median, the robust deviation of their logarithms, and
    whether the median is off beyond that.
    """
    of = np.log(np.maximum(np.abs(factors[np.isfinite(factors)]), 1e-300))
    if len(of) < 2:
        return 1.0, 0.0, False
    scatter, off = 1.4826 * np.median(np.abs(of - np.median(of))), np.median(of)
    limit = np.clip(MAX_SCATTERS * scatter, np.log(LEAST_FACTOR), np.log(SURE_FACTOR))
    of_median = scatter * np.sqrt(0.5 * np.pi / len(of))  # its deviation
    is_common = bool(abs(off) > max(limit, MAX_SCATTERS * of_median))
    return float(np.exp(off)), float(scatter), is_common


def centre_of_mass_test(evidence: FitData) -> TrustLine | None:
    """How far the centre of mass by the recordings alone is from the stated one; the
    line of the worst payload.
    """
    names, lines = evidence.estimate.names, list[TrustLine | None]()
    for one in filter(None, dict.fromkeys(arm.payload for arm in evidence.arms)):
        stated = {name: of for name, of in one.stated.items() if name in names}
        if not stated or not one.payload.mass_kg:
            continue
        alone = by_rows_alone(evidence.estimate, evidence.W, evidence.Y)
        found, at = intervals_of(evidence.observed.system, alone), list(map(names.index, stated))
        value, half = np.array(list(stated.values())).T
        off, C = alone.beta[at] - value, found.covariance[np.ix_(at, at)]
        size, mm = float(np.linalg.norm(off)), 1e3 / one.payload.mass_kg
        far, along = mm * size, off / max(size, 1e-300)
        width = mm * found.reach * float(np.sqrt(along @ C @ along))
        lines.append(
            judge(
                "centre of mass",
                {
                    "differs": differs(off, C + np.diag((half / found.reach) ** 2), found.freedom),
                    "ok": True,
                },
                value=far,
                figures=figures_of(["distance"], [far], [width], [0.0]),
                half=width,
                stated=1e3 * one.payload.center_half_width_m,
            )
        )
    return worst_of(lines)


def payload_assumptions(evidence: FitData) -> Iterator[Assumed]:
    """Mass and frame of the payloads, which no test covers."""
    found = dict.fromkeys(arm.payload for arm in evidence.arms)
    joint = evidence.robot.joints[-1].name
    for one in filter(None, found):
        weighed, always = one.payload.mass_kg is not None, None not in found
        if weighed or always:
            yield assume(
                "payload",
                payload=one.payload.describe(joint),
                scales=weighed and evidence.gains,
                taken_off=weighed and not evidence.gains,
                both=weighed and always,
                exact=not one.payload.mass_half_width_kg,
                always=always,
            )
