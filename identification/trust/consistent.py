"""How far an estimate is from what a physical robot can have: links of positive density, rotors and friction above zero."""

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Consistent, Estimate, Intervals, consistent_parameters
from ..model import physical_parameters
from ..regression import Problem
from .evidence import Evidence
from .lines import TrustLine

FAR_LEVEL = 0.001  # of the chi-squared test: how rarely a physical robot gives an estimate this far off


def covariance_of_all(names: tuple[str, ...], estimate: Estimate, intervals: Intervals, full: Estimate) -> Array:
    """C = D R D (b, b) of all base parameters: the formula's correlations with the intervals' deviations.

    Parameters that the estimate has not count as zero with the deviations of `full`, the least squares of all of them.
    """
    covariance = np.diag(np.diag(full.covariance))
    among = np.array([names.index(name) for name in estimate.names])
    covariance[np.ix_(among, among)] = intervals.covariance
    return covariance


def nearest_consistent(problem: Problem, beta: Array, covariance: Array) -> Consistent:
    """The physically consistent parameters nearest to base parameters beta (b,) of this covariance (b, b).

    Raises `IdentificationError` where there are none to be found.
    """
    return consistent_parameters(beta, covariance, problem.base.K, physical_parameters(problem.model))


def consistent_test(evidence: Evidence) -> TrustLine:
    """How far the nearest consistent parameters are: in chi-squared, and the largest move in deviations."""
    from scipy.special import chdtri

    problem, estimate = evidence.problem, evidence.estimate
    if not problem.signals.robot.gain_known:
        text = "links cannot be compared: the drive gains are not known: state drive_gain"
        return TrustLine(test="consistent", level="not made", value=None, text=text)
    names = problem.base.names
    covariance = covariance_of_all(names, estimate, evidence.intervals, evidence.least_squares)
    try:
        nearest = nearest_consistent(problem, estimate.among(names), covariance)
    except IdentificationError as error:
        return TrustLine(test="consistent", level="cannot tell", value=None, text=str(error))
    most, bound = int(np.abs(nearest.deviations).argmax()), float(chdtri(len(names), FAR_LEVEL))
    text = f"the nearest physical robot is at chi² = {nearest.chi_squared:.3g} of {len(names)} parameters, "
    text += f"{names[most]} moved by {abs(nearest.deviations[most]):.2g} deviations"
    if nearest.chi_squared > bound:
        text += f", more than {bound:.3g} by chance: look at the signs and units of efforts and positions, and at the frames"
        return TrustLine(test="consistent", level="caution", value=nearest.chi_squared, text=text)
    return TrustLine(test="consistent", level="ok", value=nearest.chi_squared, text=text)
