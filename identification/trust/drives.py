"""Tests of the drives: the lag of their torque, their control law, their gains and what they carry.

The control law that is found in the recording does not depend on the robot's model, so its test
detects what a fit cannot: an effort of the wrong scale or sign, which scales every parameter and
fits equally well. Units are those of the recorded effort: the drive gain cancels and is not tested.
A delay of the reference belongs to the recording, not to the law: the simulated robot has it, and
nothing is judged by it.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..control import MAX_LAW_PERCENT, FoundLaw
from ..estimation import by_rows_alone, differs, intervals_of
from ..regression import LAG_ORDERS, Lag, Problem
from ..report import Assumed
from .evidence import LEVELS, FitData, TrustLine, figures_of, first_case, worst_of
from .words import WORDS

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
    rest = intervals_of(evidence.observed.system, evidence.estimate).sigma  # without the lag
    fs, names, prior = 1 / lag.period_s, evidence.estimate.names, lag.prior or lag
    late, half, value_s = lag.value_s * fs, lag.half_width_s * fs, lag.value_s
    moved = np.divide(lag.moved, rest, out=np.zeros_like(rest), where=rest > 0)
    counts = [i for i, name in enumerate(names) if name in evidence.essential] or range(len(names))
    worst = max(counts, key=lambda i: moved[i])
    found, found_sd, _ = lag.found or (value_s, 0.0, 0)
    delay, off = (fs * x for x in lag.delay_s or (0.0, 0.0))
    stated = f"{value_s:.4g} s, as torque_lag_s states"
    known = (
        f"not known, {value_s * 1e3:g} ± {lag.sd_s * 1e3:g} ms"
        if prior.source == "nothing"
        else f"{value_s * 1e3:.2g} ± {lag.sd_s * 1e3:.2g} ms by {prior.source}"
    )
    cost = f"±{moved[worst]:.2g} half-widths at {names[worst]}, included in the intervals"
    known, lost = f"{known}: {cost}", lag.found is None
    exogenous = all(one.signals.q_ref is not None for one in evidence.problems)
    unseen = Assumed(
        "lag",
        f"{value_s * 1e3:.2g} ± {lag.sd_s * 1e3:.2g} ms",
        WORDS["why lag assumed"].format(cost=cost),
    )
    text = (
        f"torque {abs(late):.2f} ± {half:.2f} samples {'late' if late >= 0 else 'early'}: "
        "corrected, included in the intervals"
        + f"; {prior.source} gives {prior.value_s * fs:.2f}, which contradicts it and is not used"
        * (lag.source == "data")
        + f"; it acts {delay:.2f} ± {off:.2f} samples after the command" * (lag.delay_s is not None)
        + f"; whitened over {lag.order} rows, not {LAG_ORDERS[0]}, as joints reverse often"
        * (0 < lag.order < LAG_ORDERS[0])
    )
    return first_case(
        "lag",
        (
            lag.stated and abs(found - value_s) > MAX_DEVIATIONS_FROM_STATED * found_sd,
            "caution",
            f"{stated}; the data give {found:.4g} ± {found_sd * lag.reach:.2g} s: leave "
            "torque_lag_s out",
        ),
        (lag.stated, "ok", stated),
        (lost and moved[worst] <= 1, "ok", known),
        (
            lost and exogenous,
            "caution",
            WORDS[f"lag not {'shown' if evidence.candidates.simulated else 'measured'}"].format(
                known=known
            ),
        ),
        (
            lost,
            "cannot tell",
            WORDS["lag assumed"].format(known=known),
        ),
        (
            delay < -MAX_EARLY_SAMPLES - off,
            "caution",
            f"{text}, which is impossible: check sample_rate_hz of [controller], time stamps, and "
            "whether the effort is recorded behind a filter",
        ),
        (True, "ok", text),
        value=late,
        figures=figures_of(["lag"], [late], [half], [prior.value_s * fs]),
        unit="samples",
        assumed=(unseen,) * (lost and not lag.stated and not exogenous),
    )


def control_law_test(evidence: FitData) -> TrustLine:
    """Whether the described controllers give the recorded efforts: the line
    of the worst recording.
    """
    worst, name = min(
        zip(map(law_line, evidence.problems, evidence.laws), evidence.names, strict=True),
        key=lambda one: (
            LEVELS.index(one[0].level),
            -abs((1.0 if (x := one[0].value) is None else x) - 1.0),
        ),
    )
    if len(evidence.names) == 1:
        return worst
    reason = worst.text.removeprefix("not made: ")
    return replace(worst, text=f"{'not made: ' if reason != worst.text else ''}{name}: {reason}")


def law_line(problem: Problem, law: FoundLaw | None) -> TrustLine:
    """Return the line of a recording."""
    signals, controller = problem.signals, problem.signals.robot.controller
    if signals.q_ref is None:
        reason = "the recording has no reference"
    elif controller.structure == "computed_torque":
        reason = "computed torque depends on the robot's own model"
    elif law is None:
        reason = "the recording is too short"
    elif law.described is None and law.reason is not None:
        reason = f"[controller] describes no law, and none is found in the recording: {law.reason}"
    else:
        fed = "; gravity that is fed forward is fitted and subtracted"
        line = _line_of_law(law, [motor.name for motor in signals.robot.motors])
        assert line is not None
        return replace(line, text=line.text + fed * controller.gravity_feedforward)
    return TrustLine(LAW, "not made", f"not made: {reason}")


def _line_of_law(found: FoundLaw, motors: list[str]) -> TrustLine | None:
    used, error = found.used, found.residual_percent
    delays = f"reference {1e3 * float(np.median(found.delay_s)):.3g} ms late"
    if found.described is None:
        alone = ", ".join(np.array(motors)[~found.clear])
        unclear = f"; {alone} alone do not show it" if alone else ""
        return TrustLine(
            LAW,
            "ok",
            f"{found.law.structure} found, {_gains(found, 0)} of motor {motors[0]}, "
            f"{error.max():.2g} % left; {delays}{unclear}",
        )
    gains, described, half = found.gains[used], found.described[used], found.gains_half[used]
    factor, within = gains / described, half / described
    names = [f"{letter} {motor}" for letter in np.array(LETTERS)[used] for motor in motors]
    figures = figures_of(names, factor.flat, within.flat, np.ones(factor.size))
    off = np.nan_to_num(np.abs(factor - 1) * (np.abs(factor - 1) > 2 * within))
    mirrored = (factor < 0).all(axis=0) & (error <= MAX_MIRRORED_PERCENT)
    beyond = np.maximum(off.max(axis=0) / MAX_GAIN_ERROR, error / MAX_LAW_PERCENT)
    j = int(np.argmax(np.maximum(beyond, 1e9 * mirrored)))
    value = float(factor[int(np.argmax(off[:, j])), j])
    text = f"motor {motors[j]}: {_gains(found, j)}; {error[j]:.2g} % left; {delays}"
    if found.reason is not None and not mirrored[j] and (factor[:, j] < 0).any():
        another = "a feed-forward that is not recorded, or another law?"
        return TrustLine(LAW, "caution", f"{found.reason}, {error[j]:.2g} % left: {another}")
    return first_case(
        LAW,
        (mirrored.any(), "do not use", f"{text}: check the sign of its effort"),
        (
            found.rival,
            "caution",
            f"{text}: {found.rival} fits better than {found.law.structure}: check structure and "
            "gains of [controller]",
            f"{found.rival} for {found.law.structure}",
        ),
        (
            beyond[j] > 1 and np.ptp(factor[:, j]) < COMMON,
            "caution",
            f"{text}: the effort is {value:.3g} x the law's: check rated value, ratio and "
            "drive_gain",
        ),
        (
            beyond[j] > 1,
            "caution",
            f"{text}: check structure, gains and sample rate of [controller], and whether the "
            "effort is recorded behind a filter",
        ),
        (True, "ok", text),
        value=value,
        figures=tuple(one for one in figures if np.isfinite(one[1])),
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
    motors = [m for m, motor in enumerate(robot.motors) if f"K:{motor.name}" in evidence.gains]
    names = [robot.motors[m].name for m in motors]
    at = [of.index(f"K:{name}") for name in names]
    factor, gains = evidence.estimate.beta[at], [robot.motors[m].gain for m in motors]
    half = 100 * evidence.intervals.half[at] / np.abs(factor)
    described = np.array([np.nan if gain is None else gain for gain in gains])
    K = factor * np.nan_to_num(described, nan=1.0)
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
    for one in filter(None, found):
        weighed = one.payload.mass_kg is not None
        whys = (
            (
                weighed and evidence.gains,
                "drive gains and all parameters scale with its mass",
            ),
            (
                weighed and not evidence.gains,
                "it is taken off the arm"
                + ", as if it were exact: no half-width of its mass is stated"
                * (not one.payload.mass_half_width_kg),
            ),
            (
                None not in found,
                "no recording is without payload: the parameters include what is not stated of "
                "the lightest",
            ),
        )
        if why := "; ".join(text for holds, text in whys if holds):
            yield Assumed("payload", one.payload.describe(joint), why)
