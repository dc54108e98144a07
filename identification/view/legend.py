"""Says in words what the pictures of a fit, or of a recording that is not fitted, show."""

import numpy as np

from ..data import Signals
from ..methods import Fit
from ..regression import Settings
from ..report import Cell, Number, Section, Table, columns
from .curves import Observed, model_stride, thinning
from .robot_drawing import pose_stride
from .signal_panels import SHOWN_DEVIATIONS, middle_deviation, residual_of_moving


def fit_legend(signals: Signals, fit: Fit) -> Section:
    """What is drawn of a fit."""
    simulated = fit.iv is not None and fit.iv.simulated is not None
    lines = ["IDM, in orange: the torque of the inverse model with these parameters along the filtered motion."]
    if simulated:
        lines.append("DDM and simulated, in light blue: the robot simulated with these parameters, in closed loop.")
    lines.append(
        "Residual, in vermillion: of the decimated rows, measured and modelled torque through the same filter, as fitted; its "
        "autocorrelation over the lag, in grey the bounds ±2/√N of white noise; the distribution of the rows that move, within "
        "four sigma (1.48 times the median of its size), in grey the normal one."
    )
    if simulated or signals.q_ref is not None:
        lines.append(
            "Position plots of the first page: reference and simulated position, each minus the measured one; the positions "
            "themselves are on the page motion."
        )
    return Section(title="what is drawn", lines=(*lines, *_curves(signals, fit.settings, "Filtered curves and IDM")))


def numbers_of_plots(signals: Signals, fit: Fit | None, seen: Observed) -> Section:
    """What the plots of each joint come to: peak effort, tracking error, and deviation and correlation of the residual."""
    robot, heads = signals.robot, ["peak effort"]
    cells: list[list[Cell]] = [[Number(float(x), ".3g") for x in np.abs(signals.effort).max(axis=0)]]
    if signals.q_ref is not None:
        heads.append("reference − measured, rms, rad or m")
        each = zip(signals.q_ref.T, signals.q.T, strict=True)
        cells.append([Number(float(np.sqrt(np.mean((reference - q) ** 2))), ".2g") for reference, q in each])
    if fit is not None:
        rows = [residual_of_moving(seen, j) for j in range(robot.n)]
        sigmas = [middle_deviation(rho) for rho in rows]
        heads += ["residual σ", f"rows beyond {SHOWN_DEVIATIONS:g} σ", "residual lag-1"]
        cells.append([Number(sigma, ".2g") for sigma in sigmas])
        beyond = zip(rows, sigmas, strict=True)
        cells.append([Number(int((np.abs(rho) > SHOWN_DEVIATIONS * sigma).sum()), "d") for rho, sigma in beyond])
        cells.append([Number(e.autocorrelation, ".2f") for e in fit.errors[:-1]])
    names = [joint.name for joint in robot.joints]
    table = Table(
        columns=columns("joint", "unit", numbers=tuple(heads)),
        rows=tuple(zip(names, robot.effort_units, *cells, strict=True)),
    )
    return Section(title="numbers of the plots", table=table)


def recording_legend(signals: Signals, settings: Settings | None) -> Section:
    """What is drawn of a recording that is not fitted."""
    return Section(title="what is drawn", lines=_curves(signals, settings, "Filtered curves"))


def _curves(signals: Signals, settings: Settings | None, filtered: str) -> tuple[str, ...]:
    """How the curves come from the samples, and what of them is shown."""
    N, fs = len(signals.q), signals.sample_rate_hz
    step, stride = thinning(N), model_stride(signals, settings) if settings else 1
    lines = [
        "Measured, in grey: the recording as it is, all of it; dq and ddq are central differences of the raw position, and "
        "off where noise would drown the rest: a click in the legend shows them."
    ]
    if settings is not None and settings.cutoff_hz is not None:
        lines.append("Filtered, in orange: the measured motion through the low-pass, over the span to fit.")
    if step == 1:
        lines.append("Curves show every sample.")
    else:
        lines.append(f"For display, of every {step} samples measured curves show the lowest and the highest.")
    if stride > 1:
        lines.append(f"{filtered} show every {stride}th sample, {fs / stride:g} a second.")
    lines.append(f"The robot takes {fs / pose_stride(N, fs):.3g} poses a second.")
    return tuple(lines)
