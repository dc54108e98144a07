"""The control law found in the recording, against the one that is described.

The law does not depend on the robot's model, so the test detects what a fit cannot: an effort of
the wrong scale or sign, which scales every parameter and fits equally well. Units are those of the
recorded effort: the drive gain cancels and is not tested. A delay of the reference belongs to the
recording, not to the law: the simulated robot has it, and nothing is judged by it.
"""

from dataclasses import replace

import numpy as np

from ..regression import KnownLag, Law, Problem
from .fit_data import FitData
from .lines import LEVELS, Figure, TrustLine

NAME = "control law"
DRIVE_DELAY_S = 0.0005  # deviation of the delay from command to torque
MAX_GAIN_ERROR, MAX_ERROR_PERCENT = 0.01, 5.0  # beyond: caution
MAX_MIRRORED_PERCENT = 2.0  # residual of negative gains; below, the effort has the wrong sign
COMMON = 0.02  # spread of the gains' factors, for one scale of the effort
LETTERS = ("Kp", "Kd", "Ki")


def control_law_test(evidence: FitData) -> TrustLine:
    """Whether the described controllers give the recorded efforts: the line
    of the worst recording.
    """
    worst, name = min(
        zip(evidence.replays, evidence.names, strict=True), key=lambda one: _rank(one[0])
    )
    if len(evidence.names) == 1:
        return worst
    reason = worst.text.removeprefix("not made: ")
    return replace(worst, text=f"{'not made: ' if reason != worst.text else ''}{name}: {reason}")


def _rank(line: TrustLine) -> tuple[int, float]:
    """Sort key: the worst level, then the gain furthest from the described one."""
    return LEVELS.index(line.level), -abs((1.0 if line.value is None else line.value) - 1.0)


def law_line(problem: Problem) -> tuple[TrustLine, KnownLag | None]:
    """The line of a recording, and the lag of its torque by the described law, without an estimate.

    A command acts from its tick to the next one, on average half a period later; the drive's own
    delay is not included.
    """
    law, signals, controller = problem.law, problem.signals, problem.signals.robot.controller
    reason = "the recording is too short"
    if signals.q_ref is None:
        reason = "the recording has no reference"
    elif controller.structure == "computed_torque":
        reason = "computed torque depends on the robot's own model"
    elif law is not None and law.described is None and law.reason is not None:
        reason = f"[controller] describes no law, and none is found in the recording: {law.reason}"
    elif law is not None:
        line = _line(law, [motor.name for motor in signals.robot.motors])
        if controller.gravity_feedforward:
            line = replace(
                line, text=f"{line.text}; gravity that is fed forward is fitted and subtracted"
            )
        return line, _lag(law, problem)
    return TrustLine(NAME, "not made", f"not made: {reason}"), None


def _lag(law: Law, problem: Problem) -> KnownLag | None:
    """The lag of the torque where the described law gives the effort; drives have loops that
    a description does not.
    """
    similar = law.residual_percent <= MAX_ERROR_PERCENT
    if law.described is None or problem.signals.of_drives or not similar.any():
        return None
    value_s = float(law.lag_s[similar].mean()) - 0.5 * law.period_s
    sd_s = float(np.hypot(law.lag_sd_s[similar].max(), DRIVE_DELAY_S))
    return KnownLag(value_s=value_s, sd_s=sd_s, source="the described control law")


def _line(law: Law, motors: list[str]) -> TrustLine:
    used, error = law.used, law.residual_percent
    delays = f"reference {1e3 * float(np.median(law.delay_s)):.3g} ms late"
    if law.described is None:
        text = (
            f"{law.structure} found, {_gains(law, 0)} of motor {motors[0]}, {error.max():.2g} "
            f"% left; {delays}"
        )
        if not law.clear.all():
            text += f"; {', '.join(np.array(motors)[~law.clear])} alone do not show it"
        return TrustLine(NAME, "ok", text)
    gains, described, half = law.gains[used], law.described[used], law.gains_half[used]
    factor = np.divide(gains, described, out=np.ones_like(gains), where=described != 0)
    within = np.divide(half, np.abs(described), out=np.zeros_like(gains), where=described != 0)
    figures = tuple(
        Figure(
            name=f"{letter} {motor}",
            value=float(factor[i, j]),
            half_width=float(within[i, j]),
            expected=1.0,
        )
        for i, letter in enumerate(np.array(LETTERS)[used])
        for j, motor in enumerate(motors)
        if np.isfinite(factor[i, j])
    )
    off = np.nan_to_num(np.abs(factor - 1) * (np.abs(factor - 1) > 2 * within))
    mirrored = (factor < 0).all(axis=0) & (error <= MAX_MIRRORED_PERCENT)
    beyond = np.maximum(off.max(axis=0) / MAX_GAIN_ERROR, error / MAX_ERROR_PERCENT)
    j = int(np.argmax(np.maximum(beyond, 1e9 * mirrored)))
    value = float(factor[int(np.argmax(off[:, j])), j])
    text = f"motor {motors[j]}: {_gains(law, j)}; {error[j]:.2g} % left; {delays}"
    if law.reason is not None and not mirrored[j] and (factor[:, j] < 0).any():
        text = (
            f"{law.reason}, {error[j]:.2g} % left: a feed-forward that is not recorded, or "
            "another law?"
        )
        return TrustLine(NAME, "caution", text, None)
    if mirrored.any():
        return TrustLine(
            NAME, "do not use", f"{text}: check the sign of its effort", value, figures=figures
        )
    if law.rival is not None:
        text += (
            f": {law.rival} fits better than {law.structure}: check structure and gains of "
            "[controller]"
        )
        return TrustLine(
            NAME,
            "caution",
            text,
            value,
            figures=figures,
            finding=f"{law.rival} for {law.structure}",
        )
    if off[:, j].max() > MAX_GAIN_ERROR or error[j] > MAX_ERROR_PERCENT:
        spread = float(np.ptp(factor[:, j]))
        scale = f": the effort is {value:.3g} x the law's: check rated value, ratio and drive_gain"
        text += (
            scale if spread < COMMON else ": check structure, gains and sample rate of [controller]"
        )
        return TrustLine(NAME, "caution", text, value, figures=figures)
    return TrustLine(NAME, "ok", text, value, figures=figures)


def _gains(law: Law, j: int) -> str:
    """The gains of a motor with their half-widths, and those described."""
    return ", ".join(
        f"{LETTERS[i]} {law.gains[i, j]:.5g} ± {law.gains_half[i, j]:.2g}"
        + ("" if law.described is None else f" of {law.described[i, j]:.5g}")
        for i in np.flatnonzero(law.used)
    )
