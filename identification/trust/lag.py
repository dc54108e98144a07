"""Whether torque and motion are synchronous, or the cost of not knowing it."""

import numpy as np

from ..regression import Lag
from .fit_data import FitData
from .lines import TrustLine, figures_of, first_case, worst_of

MAX_DEVIATIONS_FROM_STATED = 4.0  # between the data and a lag that the user states
MAX_EARLY_SAMPLES = 0.75  # of a torque before its command, besides the interval


def lag_test(evidence: FitData) -> TrustLine | None:
    """Whether torque and motion are synchronous, or the cost of not knowing it; the
    line of the worst group.
    """
    return worst_of(_line(evidence, lag) for lag in evidence.lags)


def _line(evidence: FitData, lag: Lag) -> TrustLine | None:
    fs, names, prior = 1 / lag.period_s, evidence.estimate.names, lag.prior
    late, half, value_s = lag.value_s * fs, lag.half_width_s * fs, lag.value_s
    rest = np.sqrt(np.maximum(evidence.intervals.sigma**2 - lag.moved**2, 0.0))  # without the lag
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
    known += f": ±{moved[worst]:.2g} half-widths at {names[worst]}, included in the intervals"
    text = (
        f"torque {abs(late):.2f} ± {half:.2f} samples {'late' if late >= 0 else 'early'}: "
        "corrected, included in the intervals"
        + f"; {prior.source} gives {prior.value_s * fs:.2f}, which contradicts it and is not used"
        * (lag.source == "data")
        + f"; it acts {delay:.2f} ± {off:.2f} samples after the command" * (lag.delay_s is not None)
    )
    return first_case(
        "lag",
        (
            prior.stated and abs(found - value_s) > MAX_DEVIATIONS_FROM_STATED * found_sd,
            "caution",
            f"{stated}; the data give {found:.4g} ± {found_sd * lag.reach:.2g} s: leave "
            "torque_lag_s out",
        ),
        (prior.stated, "ok", stated),
        (
            lag.found is None and moved[worst] > 1,
            "caution",
            f"{known}: state effort_timing, or record the reference",
        ),
        (lag.found is None, "ok", known),
        (
            delay < -MAX_EARLY_SAMPLES - off,
            "caution",
            f"{text}, which is impossible: check sample_rate_hz of [controller] and time stamps",
        ),
        (True, "ok", text),
        value=late,
        figures=figures_of(["lag"], [late], [half], [prior.value_s * fs]),
        unit="samples",
    )
