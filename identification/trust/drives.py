"""Tests of the drives: the delay of their torque, their control law, and limits not given.

The control law that is found in the recording does not depend on the robot's model, so its test
detects what a fit cannot: an effort of the wrong scale or sign, which scales every parameter and
fits equally well. Units are those of the recorded effort: the drive gain cancels and is not tested.
A delay of the reference belongs to the recording, not to the control law: the simulated robot has
it, and nothing is judged by it.
"""

from collections.abc import Sequence

import numpy as np
from msgspec import structs

from ..control import MAX_LAW_PERCENT, FoundLaw
from ..estimation import intervals_of
from ..regression import LAG_ORDERS, Lag, Problem
from ..report import TrustResult
from ..simulation import unstated_limits
from .evidence import LEVELS, Case, TrustInputs, Words, assume, figures_of, worst_of

MAX_DEVIATIONS_FROM_STATED = 4.0  # between the data and a lag that the user states
MAX_EARLY_SAMPLES = 0.75  # of a torque before its command, besides the interval
MAX_GAIN_ERROR = 0.01  # beyond: caution
MAX_MIRRORED_PERCENT = 2.0  # residual of negative gains; below, the effort has the wrong sign
COMMON = 0.02  # spread of the gains' factors, for one scale of the effort
LETTERS = ("Kp", "Kd", "Ki")


def lag_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether torque and motion are synchronous, or what an unknown delay costs.

    Of several groups of recordings the worst result is returned.
    """
    return worst_of(_line_of_lag(evidence, lag) for lag in evidence.lags)


def _line_of_lag(evidence: TrustInputs, lag: Lag) -> TrustResult | None:
    moved, name = _largest_move(evidence, lag)
    fs, prior, value_ms = 1 / lag.period_s, lag.prior or lag, 1e3 * lag.value_s
    late, half, sd_ms = lag.value_s * fs, lag.half_width_s * fs, 1e3 * lag.sd_s
    found, found_sd, _ = lag.found or (lag.value_s, 0.0, 0)
    delay, delay_half = (fs * x for x in lag.delay_s or (0.0, 0.0))
    lost, exogenous = lag.found is None, all(x.signals.q_ref is not None for x in evidence.problems)
    unseen = assume(
        "delay",
        lag=f"{value_ms:.2g} ± {sd_ms:.2g} ms",
        cost=LAG.part("cost", moved=moved, name=name),
        stated=False,
    )
    return LAG.judge(
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
        figures=figures_of(["delay"], [late], [half], [prior.value_s * fs]),
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


LAG = Words(
    test="delay",
    place=150,
    by=lag_test,
    of_data=True,
    advice="Set `effort_timing`, use `--method iv`, or record longer moves.",
    detects="The delay of the recorded torque after the motion. IV [estimates and corrects "
    "it](method.md#delay-of-the-torque), and the intervals include it",
    limit="`caution`: there is a reference, but it is not estimated, and its assumed uncertainty "
    "changes an essential parameter by more than one half-width; a delay is impossibly "
    "negative; or a given `torque_lag_s` differs from the data at t > 4. "
    "`inconclusive`: it is not estimated, for lack of a reference",
    cases={
        "contradicted": Case(
            "caution",
            "{stated}, but the data show {found:.4g} ± {found_half:.2g} s",
            "Remove torque_lag_s.",
        ),
        "stated": Case("ok", "{stated}"),
        "harmless": Case("ok", "{known}"),
        "not shown": Case(
            "caution",
            "{known}. Joints reverse too often for their rows to show it",
            "Set effort_timing, or record longer moves.",
        ),
        "not measured": Case(
            "caution", "{known}", "Set effort_timing, or use --method iv, which estimates it."
        ),
        "assumed": Case(
            "inconclusive",
            "{known}. Without a recorded reference it cannot be estimated",
            "Set effort_timing.",
        ),
        "impossible": Case(
            "caution",
            "{late}, which is impossible",
            "Check sample_rate_hz of [controller], timestamps, and whether the effort is recorded "
            "after a filter.",
        ),
        "ok": Case("ok", "{late}"),
    },
    parts={
        "stated": "{value_s:.4g} s, as given by torque_lag_s",
        "cost": "±{moved:.2g} half-widths at {name}, included in the intervals",
        "unknown": "not known, {value_ms:g} ± {sd_ms:g} ms",
        "by_source": "{value_ms:.2g} ± {sd_ms:.2g} ms by {source}",
        "known": "{unknown}{by_source}: {cost}",
        "rejected": "; {source} gives {prior:.2f}, which differs significantly and is not used",
        "delayed": "; it acts {delay:.2f} ± {delay_half:.2f} samples after the command",
        "whitened": "; whitened over {order} rows, not {usual}, because joints reverse often",
        "late": "torque {size:.2f} ± {half:.2f} samples {way}, corrected and included in the "
        "intervals{rejected}{delayed}{whitened}",
    },
    unit="samples",
)


def _largest_move(evidence: TrustInputs, lag: Lag) -> tuple[float, str]:
    """Return the largest shift by one standard error of the delay, and its essential parameter.

    The shift is in half-widths without the delay.
    """
    rest = intervals_of(evidence.observed.system, evidence.estimate).sigma
    moved = np.divide(lag.moved, rest, out=np.zeros_like(rest), where=rest > 0)
    names = evidence.estimate.names
    counts = [i for i, name in enumerate(names) if name in evidence.essential] or range(len(names))
    worst = max(counts, key=lambda i: moved[i])
    return moved[worst], names[worst]


def control_law_line(
    problems: Sequence[Problem], laws: Sequence[FoundLaw | None]
) -> TrustResult | None:
    """Test whether the given controllers reproduce the recorded efforts.

    Of several recordings the worst result is returned.
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
    return worst if len(names) == 1 else structs.replace(worst, text=f"{name}: {worst.text}")


def law_line(problem: Problem, law: FoundLaw | None) -> TrustResult | None:
    """Return the result of one recording."""
    signals, controller = problem.signals, problem.signals.robot.controller
    unknown = {
        "no reference": signals.q_ref is None,
        "computed torque": controller.structure == "computed_torque",
        "short": law is None,
        "none found": law and law.described is None and law.reason is not None,
    }
    if law is None or any(unknown.values()):
        return LAW.judge(unknown, reason=law and law.reason)
    line = _line_of_law(law, [motor.name for motor in signals.robot.motors])
    if line is None or not controller.gravity_feedforward:
        return line
    return structs.replace(line, text=LAW.part("fed", text=line.text))


def _line_of_law(found: FoundLaw, motors: list[str]) -> TrustResult | None:
    used, error = found.used, found.residual_percent
    delay_ms, structure = 1e3 * float(np.median(found.delay_s)), found.law.structure
    if found.described is None:
        alone = ", ".join(np.array(motors)[~found.clear])
        return LAW.judge(
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
        return LAW.judge({"another": True}, reason=found.reason, left=error[j])
    names = [f"{letter} {motor}" for letter in np.array(LETTERS)[used] for motor in motors]
    return LAW.judge(
        {
            "sign": mirrored.any(),
            "rival": found.rival,
            "scale": beyond[j] > 1 and np.ptp(factor[:, j]) < COMMON,
            "off": beyond[j] > 1,
            "ok": True,
        },
        value=float(factor[int(np.argmax(off[:, j])), j]),
        figures=tuple(
            one
            for one in figures_of(names, factor.flat, within.flat, np.ones(factor.size))
            if np.isfinite(one[1])
        ),
        motor=motors[j],
        gains=_gains(found, j),
        left=error[j],
        delay_ms=delay_ms,
        rival=found.rival,
        structure=structure,
    )


LAW = Words(
    test="control law",
    place=120,
    of_data=True,
    advice="Check rated value, ratio, sample rate and `[controller]`.",
    detects="Given gains that differ from the Kp, Kd, Ki estimated from reference, position and "
    "effort. Without a given control law, the estimated one is reported and simulated if it "
    "explains 98 % of the effort at every motor",
    limit="`do not use`: all gains are negative. `caution`: a gain differs by more than its "
    "half-width plus 1 %, another structure fits better, or 5 % of the effort is not explained",
    cases={
        "no reference": Case("skipped", "the recording has no reference"),
        "computed torque": Case("skipped", "computed torque depends on the robot's own model"),
        "short": Case("skipped", "the recording is too short"),
        "none found": Case(
            "skipped",
            "[controller] gives no control law, and none can be estimated from the recording: "
            "{reason}",
        ),
        "found": Case(
            "ok",
            "{structure} estimated, {gains} of motor {motor}, {left:.2g} % left; {late}{unclear}",
        ),
        "another": Case(
            "caution",
            "{reason}, {left:.2g} % left, as with a feedforward that is not recorded",
            "Record the feedforward, or check the structure of [controller].",
        ),
        "sign": Case("do not use", "{law}", "Check the sign of its effort."),
        "rival": Case(
            "caution",
            "{law}. {rival} fits better than {structure}",
            "Check structure and gains of [controller].",
            "{rival} for {structure}",
        ),
        "scale": Case(
            "caution",
            "{law}. The effort is {value:.3g} times that of the control law",
            "Check rated value, ratio and drive_gain.",
        ),
        "off": Case(
            "caution",
            "{law}",
            "Check structure, gains and sample rate of [controller], and whether the effort is "
            "recorded after a filter.",
        ),
        "ok": Case("ok", "{law}"),
    },
    parts={
        "late": "reference {delay_ms:.3g} ms late",
        "unclear": "; {alone} alone do not show it",
        "law": "motor {motor}: {gains}; {left:.2g} % left; {late}",
        "fed": "{text}; gravity fed forward is fitted and subtracted",
    },
)


def _gains(found: FoundLaw, j: int) -> str:
    """Return the controller gains of motor j with their half-widths.

    The text also has those given in robot.toml.
    """
    return ", ".join(
        f"{LETTERS[i]} {found.gains[i, j]:.5g} ± {found.gains_half[i, j]:.2g}"
        + ("" if found.described is None else f" of {found.described[i, j]:.5g}")
        for i in np.flatnonzero(found.used)
    )


def saturation_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether drives saturate at a limit that robot.toml does not give.

    It runs only where the controller or the simulated robot is not confirmed.
    """
    lines = filter(None, map(evidence.made.get, ("convergence", LAW.test)))
    if all(line.level not in LEVELS[:2] for line in lines):
        return None
    text = "; ".join(
        dict.fromkeys(x for one in evidence.problems for x in unstated_limits(one.with_samples()))
    )
    return SATURATION.judge(
        {"no fixed point": text and evidence.ending == "none", "not confirmed": text},
        limits=text,
        first=text.split(" in ")[0],
    )


SATURATION = Words(
    test="saturation",
    place=20,
    by=saturation_test,
    of_data=True,
    advice="Set `saturation` of the motor.",
    detects="Drives that saturate at a limit that is not given, if control law or simulated robot "
    "are not confirmed",
    limit="`do not use`: the iterations do not converge. `caution`: they do",
    cases={
        "no fixed point": Case("do not use", "{limits}", "Set saturation of the motor.", "{first}"),
        "not confirmed": Case("caution", "{limits}", "Set saturation of the motor.", "{first}"),
    },
)
