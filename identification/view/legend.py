"""Says in words what the pictures of a fit, or of a recording that is not fitted, show."""

from ..data import Signals
from ..methods import Fit
from ..regression import Settings
from ..report import Section
from .curves import model_stride, thinning
from .robot_drawing import pose_stride


def fit_legend(signals: Signals, fit: Fit) -> Section:
    """What is drawn of a fit."""
    simulated = fit.iv is not None and fit.iv.simulated is not None
    lines = ["IDM, in orange: the torque of the inverse model with these parameters along the filtered motion."]
    if simulated:
        lines.append("DDM and simulated, in blue: the robot simulated with these parameters, in closed loop.")
    lines.append(
        "Residual, in red: of the decimated rows, measured and modelled torque through the same filter, as fitted; its "
        "autocorrelation over the lag, in grey the bounds ±2/√N of white noise; the distribution of the rows that move, within "
        "four sigma (1.48 times the median of its size), in grey the normal one."
    )
    if simulated and signals.q_ref is not None:
        lines.append(
            "Over a position: rms of the reference less the measured position; sim, in percent of its variation, how far "
            "the simulated robot is off the measured position."
        )
    return Section(title="what is drawn", lines=(*lines, *_curves(signals, fit.settings, "Filtered curves and IDM")))


def recording_legend(signals: Signals, plan: Settings | None) -> Section:
    """What is drawn of a recording that is not fitted."""
    return Section(title="what is drawn", lines=_curves(signals, plan, "Filtered curves"))


def _curves(signals: Signals, plan: Settings | None, filtered: str) -> tuple[str, ...]:
    """How the curves come from the samples, and what of them is shown."""
    N, fs = len(signals.q), signals.sample_rate_hz
    step, stride = thinning(N), model_stride(signals, plan) if plan else 1
    lines = [
        "Measured, in grey: the recording as it is, all of it; dq and ddq are central differences of the raw position, and "
        "off where noise would drown the rest: a click in the legend shows them."
    ]
    if plan is not None and plan.cutoff_hz is not None:
        lines.append("Filtered, in orange: the measured motion through the low-pass, over the span to fit.")
    if step == 1:
        lines.append("Curves show every sample.")
    else:
        lines.append(f"For display, of every {step} samples measured curves show the lowest and the highest.")
    if stride > 1:
        lines.append(f"{filtered} show every {stride}th sample, {fs / stride:g} a second.")
    lines.append(f"The robot takes {fs / pose_stride(N, fs):.3g} poses a second.")
    return tuple(lines)
