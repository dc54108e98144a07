"""The parameters of a fit, and known ones, as sets to be compared."""

from ..arrays import Array
from ..estimation import Estimate, Intervals
from ..model import BaseParameters
from ..regression import base_name
from ..report import Parameter, ParameterSet
from .fit import Fit


def fitted_parameters(fit: Fit) -> ParameterSet:
    """The parameters that a fit estimated, labelled by its method: IV, LS or OLS."""
    return _estimated({"iv": "IV", "wls": "LS", "ols": "OLS"}[fit.method], fit, fit.estimate, fit.intervals)


def least_squares_parameters(fit: Fit) -> ParameterSet:
    """The parameters that least squares of the same recording estimated, labelled LS."""
    return _estimated("LS", fit, fit.least_squares.estimate, fit.least_squares.intervals)


def _estimated(label: str, fit: Fit, e: Estimate, intervals: Intervals) -> ParameterSet:
    essential = set(fit.essential.estimate.names)
    known = dict(zip(fit.base.names, zip(fit.base.units, fit.base.expressions, strict=True), strict=True))
    return ParameterSet(
        label=label,
        parameters={
            name: Parameter(
                name=name,
                value=float(value),
                low=float(low),
                high=float(high),
                unit=known[base_name(name)][0],
                expression=known[base_name(name)][1],
                sigma=float(sigma),
                essential=name in essential,
            )
            for name, value, low, high, sigma in zip(
                e.names, e.beta, intervals.low, intervals.high, e.sigma, strict=True
            )
        },
    )


def true_parameters(base: BaseParameters, true: Array) -> ParameterSet:
    """Known values `true` (b,) of the base parameters, SI, labelled `true`; their deviations are 0."""
    return ParameterSet(
        label="true",
        parameters={
            name: Parameter(name=name, value=float(x), unit=unit, expression=expression)
            for name, x, unit, expression in zip(base.names, true, base.units, base.expressions, strict=True)
        },
    )
