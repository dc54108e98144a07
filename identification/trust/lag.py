"""The lag of the recorded torque behind the motion: one per group of recordings, estimated with
instruments in rows of its own (`regression.Rows.late`).

Prior information (effort timing of the recording, replay of the described controller) is
combined with it by variances.
"""

import numpy as np

from ..arrays import Array
from ..estimation import LEVEL, Estimate, System, t_quantile
from ..regression import KnownLag
from ..report import Level
from .fit_data import FitData, Lag
from .lines import Figure, TrustLine

CHANCE = 0.003  # of data that a true prior differs from by more: only the data are used then
MAX_DEVIATIONS_FROM_STATED = 4.0  # between the data and a lag that the user states
MAX_EARLY_SAMPLES = 0.75  # of a torque before its command, besides the interval


def combined_lag(prior: KnownLag, found: tuple[float, float, int] | None) -> Lag:
    """The lag of a group from its prior and the data, `found` as in `Lag`, compared by
    Student's t as of Welch (1947).
    """
    counted, reach = prior, 2.0
    if found is not None and not prior.stated:
        value, sd, freedom = found
        data, both = (
            KnownLag(value_s=value, sd_s=sd, source="data"),
            float(np.hypot(sd, prior.sd_s)),
        )
        reach = t_quantile(0.5 + LEVEL / 2, freedom)
        far = (
            abs(value - prior.value_s)
            > t_quantile(1 - CHANCE / 2, freedom * (both / sd) ** 4) * both
        )
        counted = data if far else prior.with_other(data)
    value_s, sd_s, source = counted.value_s, counted.sd_s, counted.source
    return Lag(value_s=value_s, sd_s=sd_s, reach=reach, source=source, prior=prior, found=found)


def moves_of(system: System, columns: Array, estimate: Estimate) -> Array:
    """d beta / d known (b, K): bread QᵀC of the torque C (r, K) per unit of something known
    that the estimate holds.
    """
    weight = estimate.weights[system.joint_of_row]
    return np.asarray(estimate.bread @ (estimate.Q.T @ (columns * weight[:, None])))


def lag_test(evidence: FitData) -> TrustLine:
    """Whether torque and motion are synchronous, or the cost of not knowing it; the
    line of the worst group.
    """
    lines = [_line(evidence, lag) for lag in evidence.lags]
    return max(lines, key=lambda line: (line.level == "caution", abs(line.value or 0.0)))


def _line(evidence: FitData, lag: Lag) -> TrustLine:
    fs = evidence.problem.signals.sample_rate_hz
    late, half = lag.value_s * fs, lag.half_width_s * fs
    figures = (Figure(name="lag", value=late, half_width=half, expected=lag.prior.value_s * fs),)
    level: Level = "ok"
    text = f"torque {abs(late):.2f} ± {half:.2f} samples {'late' if late >= 0 else 'early'}"
    names = evidence.estimate.names
    rest = np.sqrt(np.maximum(evidence.intervals.sigma**2 - lag.moved**2, 0.0))  # without the lag
    moved = np.divide(lag.moved, rest, out=np.zeros_like(rest), where=rest > 0)
    counts = [i for i, name in enumerate(names) if name in evidence.essential] or range(len(names))
    worst = max(counts, key=lambda i: moved[i])
    cost = f"±{moved[worst]:.2g} half-widths at {names[worst]}"
    if lag.prior.stated:
        text = f"{lag.value_s:.4g} s, as torque_lag_s states"
        if (
            lag.found is not None
            and abs(lag.found[0] - lag.value_s) > MAX_DEVIATIONS_FROM_STATED * lag.found[1]
        ):
            level = "caution"
            text += (
                f"; the data give {lag.found[0]:.4g} ± {lag.found[1] * lag.reach:.2g} s: leave "
                "torque_lag_s out"
            )
    elif lag.found is None:
        known = (
            f"not known, {lag.value_s * 1e3:g} ± {lag.sd_s * 1e3:g} ms"
            if lag.prior.source == "nothing"
            else f"{lag.value_s * 1e3:.2g} ± {lag.sd_s * 1e3:.2g} ms by {lag.prior.source}"
        )
        text = f"{known}: {cost}, included in the intervals"
        if moved[worst] > 1:
            level, text = "caution", f"{text}: state effort_timing, or record the reference"
    else:
        text += ": corrected, included in the intervals"
        if lag.source == "data":
            text += (
                f"; {lag.prior.source} gives {lag.prior.value_s * fs:.2f}, which contradicts "
                "it and is not used"
            )
        if lag.delay_s is not None:
            delay, off = lag.delay_s[0] * fs, lag.delay_s[1] * fs
            text += f"; it acts {delay:.2f} ± {off:.2f} samples after the command"
            if delay < -MAX_EARLY_SAMPLES - off:
                level = "caution"
                text += (
                    ", which is impossible: check sample_rate_hz of [controller] and time stamps"
                )
    return TrustLine("lag", level, text, late, figures=figures, unit="samples")
