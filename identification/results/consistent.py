"""Physically consistent standard parameters nearest to the estimate of a fit.

A simulator accepts these parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Robot

from ..arrays import Array
from ..estimation import (
    consistent_parameters,
    covariance_of_all,
    one_thread,
    parameter_certainty,
)
from ..model import BaseParameters, InverseModel, expected_links, physical_parameters
from ..regression import recorded_power
from ..report import ConsistentFile, StandardParameter
from .evidence import Evidence, errors_on, validated
from .parameters import refuse_unknown_gain

# Above this share of the variance by the prior alone, a value comes more from the prior than from
# the recording.
MIN_PRIOR_SHARE = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Known:
    """An estimate beta (b,) and its covariance C = D R D (b, b).

    `reach` is the number of standard errors in half a 95 % interval.
    """

    beta: Array
    covariance: Array
    reach: float


@one_thread
def with_consistent(fit: Evidence, prior: Robot | None = None) -> Evidence:
    """Return the fit with the nearest physically consistent parameters and their torque error.

    The estimate stays the same.

    Parameters
    ----------
    fit : the fit.
    prior : robot with the a priori links; None for the fitted description.

    Raises
    ------
    BadInputError : a drive gain is not known, the prior is of another robot, or no physically
        consistent parameters are found.
    """
    own = fit.recordings[0].names  # of own parameters those of one recording
    known = Known(
        beta=fit.beta,
        covariance=covariance_of_all(own, fit.estimate, fit.intervals, fit.full),
        reach=fit.intervals.reach,
    )
    power = recorded_power([one.problem for one in fit.recordings if one.names == own], fit.beta)
    found, standard = consistent_set(fit.problem.model, fit.base, known, prior=prior, power=power)
    beta = np.array([one.value for one in found.base_parameters or ()])
    *_, error = errors_on([validated(one.problem, beta + one.carried) for one in fit.recordings])
    found = msgspec.structs.replace(found, relative_error_percent=error.relative_error_percent)
    return replace(fit, consistent_set=found, standard_parameters=standard)


@one_thread
def consistent_set(
    model: InverseModel,
    base: BaseParameters,
    known: Known,
    *,
    prior: Robot | None = None,
    power: Array | None = None,
) -> tuple[ConsistentFile, tuple[StandardParameter, ...]]:
    """Return the physically consistent base and standard parameters nearest to the `known` ones.

    Parameters
    ----------
    model, base : the robot's model and its base parameters.
    known : the estimate with its covariance.
    prior : robot with the a priori links; None for its own description.
    power : power of friction at recorded speeds, for further friction terms; None without such
        terms or known speeds.

    Raises
    ------
    BadInputError : as in `with_consistent`.
    """
    refuse_unknown_gain(model.robot)
    expected = None if prior is None else InverseModel(prior)
    physical = physical_parameters(model, expected, power)
    found = consistent_parameters(known.beta, known.covariance, base.K, physical)
    (sigma, share), (base_sigma, base_share) = parameter_certainty(
        found, known.covariance, base.K, physical
    )
    moves, reach = found.deviations / known.reach, known.reach
    of_base = standard_parameters(
        base.names, base.units, found.beta, reach * base_sigma, base_share > MIN_PRIOR_SHARE, moves
    )
    return ConsistentFile(
        prior=f"{'the description' if prior is None else prior.name}: "
        f"{_in_words(expected_links(model, expected)[1])}",
        chi2=found.chi_squared,
        largest_move=float(np.abs(moves).max()),
        moved_most=base.names[int(np.abs(found.deviations).argmax())],
        certificate=found.decrement,
        base_parameters=list(of_base),
    ), standard_parameters(
        model.names, model.units, found.chi, reach * sigma, share > MIN_PRIOR_SHARE
    )


def standard_parameters(
    names: Sequence[str], units: Sequence[str], values: Array, *columns: NDArray[Any]
) -> tuple[StandardParameter, ...]:
    """Return parameters from their values (p,) and further columns.

    The columns are half-widths, a mask of those from the prior and, for base parameters, changes.
    """
    half, from_prior, *moves = (x.tolist() for x in columns)
    return tuple(map(StandardParameter, names, values.tolist(), units, from_prior, half, *moves))


def _in_words(sources: tuple[str, ...]) -> str:
    """Return the sources in words: `links 1, 2 by the URDF; link 3 by their lengths (guess)`."""
    words = {
        "[parameters]": "by [parameters]",
        "URDF": "by the URDF",
        "plausible": "by their lengths (guess)",
    }
    of = {source: [str(j + 1) for j, s in enumerate(sources) if s == source] for source in words}
    return "; ".join(
        f"{'all links' if len(links) == len(sources) else 'links ' + ', '.join(links)} "
        f"{words[source]}"
        for source, links in of.items()
        if links
    )
