"""Physically consistent standard parameters nearest to the estimate of a fit.

A simulator accepts these parameters. Draws of them have the intervals of the fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from acquisition.errors import Location
from acquisition.robot import Robot

from ..arrays import Array
from ..estimation import (
    GAMMA_X,
    NORMAL_REACH,
    consistent_parameters,
    covariance_of_all,
    one_thread,
    parameter_certainty,
    pseudo_inertia,
)
from ..model import (
    SHAPES,
    BaseParameters,
    InverseModel,
    base_parameters,
    expected_links,
    link_columns,
    physical_parameters,
    requirements,
)
from ..regression import recorded_power
from ..report import ConsistentFile, FitFile, StandardParameter, base_name, known
from .evidence import Evidence, errors_on, validated
from .parameters import refuse_unknown_gain, stored_beta

# Above this share of the variance by the prior alone, a value comes more from the prior than from
# the recording.
MIN_PRIOR_SHARE = 0.5
# Weight of the model's own pseudo-inertias in its draws. With the weight of a fit, the draws of
# uncertain parameters would spread less than half as far as their intervals.
DRAW_WEIGHT = 0.01
# Smallest eigenvalue of a condition in a draw, relative to the model and to the rms of all draws;
# below, the condition is active.
MIN_EIGENVALUE = 0.05
MIN_SHARE = 0.05  # of the draws; a condition that is active in fewer hardly narrows the spread
# Share of a parameter's variance that those in active conditions explain. Even if the conditions
# leave these no spread at all, the parameter keeps 90 % of its own.
MAX_EXPLAINED = 0.19


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


def stored_estimate(
    stored: FitFile, model: InverseModel, place: str
) -> tuple[BaseParameters, Known, Array]:
    """Return the base parameters of a stored fit, its estimate of them, and their C (b, b).

    Per-recording parameters have their mean; in a physically consistent set, and then here, they
    are those of the first recording. C is zero for parameters that the fit left out. The covariance
    of the estimate has their standard errors by least squares.

    Raises
    ------
    BadInputError : the fit is of another robot, or of a version without covariance.
    """
    left_out = {p.name: p.sigma for p in stored.left_out or ()}
    # Further friction terms may be left out altogether, which is not to estimate them as zero.
    base = base_parameters(model).without(
        {term.name for term in model.terms.values() if term.kind in SHAPES}
        - {*left_out, *(base_name(p.name) for p in stored.parameters)}
    )
    found = Location(place).given(
        known(stored.covariance),
        "covariance",
        None,
        text="a fit cannot be made physically consistent without it",
        advice="Fit again: `robot-identify fit --consistent RECORDING.mcap`",
    )
    names, values = found.names, np.array(found.values)
    shared = {
        name: [own for own in names if base_name(own) == name][
            : 1 if stored.standard_parameters else None
        ]
        for name in base.names
    }
    missing = [name for name, own in shared.items() if not own and name not in left_out]
    Location(place).require(
        not missing and values.shape == (len(names), len(names)),
        "covariance",
        text=f"lacks {', '.join(missing[:5])}" if missing else "",
        expected="one row and column per parameter",
    )
    mean = np.array([[(x in own) / max(len(own), 1) for x in names] for own in shared.values()])
    C, sigma = mean @ values @ mean.T, dict(zip(names, np.sqrt(np.diag(values)), strict=True))
    reach = np.median([p.half / sigma[p.name] for p in stored.parameters if sigma.get(p.name)] or 1)
    return (
        base,
        Known(
            beta=stored_beta(stored, base, place),
            covariance=np.diag([left_out.get(name, 0.0) ** 2 for name in base.names]) + C,
            reach=float(reach),
        ),
        C,
    )


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Draws:
    """Physically consistent parameters drawn around those of a model.

    Attributes:
        chi: (N, p) standard parameters.
        changes: (N,) largest change of a base parameter for physical consistency, in half-widths of
            its 95 % interval.
        narrowed: rms distance from the model relative to that before these changes, by base
            parameter.
        at_bound: share of the draws in which a condition is active, by condition, at least
            `MIN_SHARE`.
        regular: (b,) mask of the parameters that keep their spread: they have no part in these
            conditions, and hardly depend on those that have one (`MAX_EXPLAINED`).
    """

    chi: Array
    changes: Array
    narrowed: Mapping[str, float]
    at_bound: Mapping[str, float]
    regular: NDArray[np.bool_]


@one_thread
def draw_consistent(
    model: InverseModel,
    base: BaseParameters,
    known: Known,
    errors: Array,
    chi: Array,
    drawn: tuple[int, int],
) -> Draws:
    """Draw physically consistent parameters around the parameters chi (p,) of a model.

        beta_k = K chi + e_k,     e_k ~ N(0, (t / 1.96)² C)

    So 95 % of the e_k are within the 95 % intervals, whose half-widths are t standard errors. Each
    draw has the physically consistent parameters nearest to beta_k by C, and the values that no
    torque depends on are nearest to those of chi.

    Parameters
    ----------
    model, base : the robot's model and its base parameters.
    known : the estimate with its covariance.
    errors : (b, b) the C of e_k, with zeros for parameters that are not drawn.
    chi : physically consistent parameters.
    drawn : number N of draws, and their seed.

    Raises
    ------
    NoFitError : the parameters of a draw are not found.
    """
    half = np.maximum(known.reach * np.sqrt(np.diag(known.covariance)), np.finfo(float).tiny)
    R = known.reach**2 * errors / half[:, None] / half
    e = np.random.default_rng(drawn[1]).multivariate_normal(
        np.zeros(base.b), R, size=drawn[0], method="eigh"
    )
    e *= half / NORMAL_REACH
    # A fit with the power of friction at its recorded speeds may not meet all conditions.
    met = {
        text: matrix
        for matrix, _, text in requirements(model, shaped=True)
        if np.linalg.eigvalsh(matrix @ chi)[0] > 0
    }
    physical = replace(
        physical_parameters(model),
        prior=pseudo_inertia(chi[link_columns(model)]),
        combinations=np.array([x[0, 0] for x in met.values() if len(x) == 1]).reshape(-1, model.p),
        start=chi,
        matrices=tuple(x for x in met.values() if len(x) > 1),
    )
    X = np.array(
        [
            consistent_parameters(
                beta,
                known.covariance,
                base.K,
                physical,
                gamma=DRAW_WEIGHT,
                gamma_x=GAMMA_X / DRAW_WEIGHT,
            ).chi
            for beta in base.K @ chi + e
        ]
    )
    cones = {text: np.moveaxis(x, -1, 0) for text, x in met.items()} | {
        f"link {j + 1}": pseudo_inertia(np.eye(model.p)[:, columns])
        for j, columns in enumerate(physical.links)
    }
    at_bound = {
        text: share
        for text, cone in cones.items()
        if (share := _share_at_bound(cone, chi, X)) >= MIN_SHARE
    }
    bound = base.K[:, sum((cones[x].any(axis=(1, 2)) for x in at_bound), chi < chi)].any(axis=1)
    moved = (X - chi) @ base.K.T
    return Draws(
        chi=X,
        changes=np.abs((moved - e) / half).max(axis=1),
        narrowed={
            name: float(np.linalg.norm(moved[:, i]) / np.linalg.norm(e[:, i]))
            for i, name in enumerate(base.names)
            if errors[i, i]
        },
        at_bound=at_bound,
        regular=np.einsum("ib,bi->i", R[:, bound], np.linalg.pinv(R[bound][:, bound]) @ R[bound])
        < MAX_EXPLAINED,
    )


def _share_at_bound(cone: Array, chi: Array, X: Array) -> float:
    """Return the share of the draws X (N, p) around chi in which a condition is active.

    `cone` (p, s, s) are the matrices whose sum with the parameters is positive definite.
    """
    lowest = np.linalg.eigvals(
        np.linalg.solve(*(np.tensordot(x, cone, axes=1) for x in (chi, X)))
    ).real.min(axis=1)
    return float(np.mean(lowest < MIN_EIGENVALUE * max(1.0, np.sqrt(np.mean(lowest**2)))))


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
