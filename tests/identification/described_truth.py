"""The parameters of a described robot beside those of a fit of its recordings."""

import numpy as np

from acquisition.robot import Robot
from identification.model import InverseModel, described_parameters
from identification.results import Evidence


def truth_of(fit: Evidence, robot: Robot | None = None) -> np.ndarray:
    """True values (p,) of the estimated parameters, of `robot` or of the one that is described in
    the recordings; a recording's own parameters have the value of all.
    """
    truth = described_parameters(InverseModel(robot or fit.problem.signals.robot), fit.base)
    by_name = dict(zip(fit.base.names, truth, strict=True))
    return np.array([by_name[name.partition("@")[0]] for name in fit.estimate.names])


def off(fit: Evidence, robot: Robot | None = None) -> np.ndarray:
    """Distances (p,) of the estimates from the truth, in half-widths."""
    return np.abs(fit.estimate.beta - truth_of(fit, robot)) / fit.intervals.half
