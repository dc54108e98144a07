"""The control law found in the recording, against the one that is described.

The law does not depend on the robot's model, so the test detects what a fit cannot: an effort of
the wrong scale or sign, which scales every parameter and fits equally well. Units are those of the
recorded effort: the drive gain cancels and is not tested. A delay of the reference belongs to the
recording, not to the law: the simulated robot has it, and nothing is judged by it.
"""

from dataclasses import replace

import numpy as np

from ..regression import MAX_LAW_PERCENT, Law, Problem
from .fit_data import FitData
from .lines import LEVELS, TrustLine, figures_of, first_case

NAME = "control law"
MAX_GAIN_ERROR = 0.01  # beyond: caution
MAX_MIRRORED_PERCENT = 2.0  # residual of negative gains; below, the effort has the wrong sign
COMMON = 0.02  # spread of the gains' factors, for one scale of the effort
LETTERS = ("Kp", "Kd", "Ki")


def control_law_test(evidence: FitData) -> TrustLine:
    """Whether the described controllers give the recorded efforts: the line
    of the worst recording.
    """
    worst, name = min(
        zip(map(law_line, evidence.problems), evidence.names, strict=True),
        key=lambda one: (
            LEVELS.index(one[0].level),
            -abs((1.0 if (x := one[0].value) is None else x) - 1.0),
        ),
    )
    if len(evidence.names) == 1:
        return worst
    reason = worst.text.removeprefix("not made: ")
    return replace(worst, text=f"{'not made: ' if reason != worst.text else ''}{name}: {reason}")


def law_line(problem: Problem) -> TrustLine:
    """Return the line of a recording."""
    law, signals, controller = problem.law, problem.signals, problem.signals.robot.controller
    reason = "the recording is too short"
    if signals.q_ref is None:
        reason = "the recording has no reference"
    elif controller.structure == "computed_torque":
        reason = "computed torque depends on the robot's own model"
    elif law is not None and law.described is None and law.reason is not None:
        reason = f"[controller] describes no law, and none is found in the recording: {law.reason}"
    elif law is not None and (line := _line(law, [motor.name for motor in signals.robot.motors])):
        fed = "; gravity that is fed forward is fitted and subtracted"
        text = line.text + fed * controller.gravity_feedforward
        return replace(line, text=text)
    return TrustLine(NAME, "not made", f"not made: {reason}")


def _line(law: Law, motors: list[str]) -> TrustLine | None:
    used, error = law.used, law.residual_percent
    delays = f"reference {1e3 * float(np.median(law.delay_s)):.3g} ms late"
    if law.described is None:
        alone = ", ".join(np.array(motors)[~law.clear])
        return TrustLine(
            NAME,
            "ok",
            f"{law.structure} found, {_gains(law, 0)} of motor {motors[0]}, {error.max():.2g} % "
            f"left; {delays}{f'; {alone} alone do not show it' if alone else ''}",
        )
    gains, described, half = law.gains[used], law.described[used], law.gains_half[used]
    factor, within = gains / described, half / described
    names = [f"{letter} {motor}" for letter in np.array(LETTERS)[used] for motor in motors]
    figures = figures_of(names, factor.flat, within.flat, np.ones(factor.size))
    off = np.nan_to_num(np.abs(factor - 1) * (np.abs(factor - 1) > 2 * within))
    mirrored = (factor < 0).all(axis=0) & (error <= MAX_MIRRORED_PERCENT)
    beyond = np.maximum(off.max(axis=0) / MAX_GAIN_ERROR, error / MAX_LAW_PERCENT)
    j = int(np.argmax(np.maximum(beyond, 1e9 * mirrored)))
    value = float(factor[int(np.argmax(off[:, j])), j])
    text = f"motor {motors[j]}: {_gains(law, j)}; {error[j]:.2g} % left; {delays}"
    if law.reason is not None and not mirrored[j] and (factor[:, j] < 0).any():
        another = "a feed-forward that is not recorded, or another law?"
        return TrustLine(NAME, "caution", f"{law.reason}, {error[j]:.2g} % left: {another}")
    return first_case(
        NAME,
        (mirrored.any(), "do not use", f"{text}: check the sign of its effort"),
        (
            law.rival,
            "caution",
            f"{text}: {law.rival} fits better than {law.structure}: check structure and gains of "
            "[controller]",
            f"{law.rival} for {law.structure}",
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
            f"{text}: check structure, gains and sample rate of [controller]",
        ),
        (True, "ok", text),
        value=value,
        figures=tuple(one for one in figures if np.isfinite(one[1])),
    )


def _gains(law: Law, j: int) -> str:
    """The gains of a motor with their half-widths, and those described."""
    return ", ".join(
        f"{LETTERS[i]} {law.gains[i, j]:.5g} ± {law.gains_half[i, j]:.2g}"
        + ("" if law.described is None else f" of {law.described[i, j]:.5g}")
        for i in np.flatnonzero(law.used)
    )
