"""The payload of a recording as an addition to the base parameters of its robot.

    beta = K chi + K_n phi,     columns L = W K_n

A payload fixed to the last link n adds its ten standard parameters phi to those of the link. The
weighed mass and the measured centre of mass of phi are known, the rest is estimated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from acquisition.robot import Payload

from ..arrays import Array, Bools
from ..errors import NoFitError
from ..estimation import (
    Estimate,
    PhysicalParameters,
    consistent_parameters,
    parameter_certainty,
    pseudo_inertia,
)
from ..model import LINK, InverseModel, link_columns, payload_parameters
from ..report import payload_name, payload_parameter
from .problem import Problem

MASS = LINK.index("M")
MOMENTS = tuple(LINK.index(name) for name in ("MX", "MY", "MZ"))
ORDER = (MASS, *MOMENTS, *(i for i in range(len(LINK)) if i not in (MASS, *MOMENTS)))
TOLERANCE = 1e-9  # of the largest column; a smaller rest is a combination of the columns before
KNOWN_SHARE = 1e-4  # relative standard deviation of known values, for the nearest rigid body
PRIOR_SHARE = 0.5  # of the variance of the prior alone; with more a value follows from the prior


@dataclass(frozen=True, kw_only=True, eq=False)
class PayloadColumns:
    """A payload in the base parameters of its robot: K_n phi = known + columns phi_f.

    Attributes:
        payload: payload as given.
        model: inverse dynamic model of the robot.
        names: (f,) names of the estimated parameters phi_f, such as MX:loaded; with the suffix R if
            others are regrouped into it.
        grouping: (f, 10) regrouping phi_f = grouping phi.
        fixed: (10,) values of phi that are known, else 0.
        known: (b,) base parameters of `fixed`.
        columns: (b, f) base parameters per unit of phi_f.
        whole: (b, 10) K_n.
    """

    payload: Payload
    model: InverseModel
    names: tuple[str, ...]
    grouping: Array
    fixed: Array
    known: Array
    columns: Array
    whole: Array

    @cached_property
    def stated(self) -> dict[str, tuple[float, float]]:
        """Given values and half-widths of estimated first moments, kg m, by name.

        First moments are estimated if the centre of mass is given with a half-width.
        """
        payload = self.payload
        if payload.mass_kg is None or payload.center_of_mass_m is None:
            return {}
        phi, half = (
            payload_parameters(self.model, payload),
            payload.mass_kg * payload.center_half_width_m,
        )
        return {
            name: (float(phi[i]), half)
            for name in self.names
            for i in MOMENTS
            if LINK[i] == payload_parameter(name)
        }

    def half_widths(self, names: tuple[str, ...]) -> list[tuple[Array, Array]]:
        """Return the changes by each half-width that is not estimated.

        These are half-widths of the mass and of each coordinate of the centre of mass. Each changes
        the base parameters (b,), and the given values of the unknowns `names` (p,).
        """
        payload, moments = self.payload, {name: value for name, (value, _) in self.stated.items()}
        mass, found = payload.mass_kg or 0.0, list[tuple[Array, Array]]()
        if mass and payload.mass_half_width_kg:
            own, x = (
                np.array([moments.get(name, 0.0) for name in some]) for some in (self.names, names)
            )
            share = payload.mass_half_width_kg / mass
            found.append((share * (self.known + self.columns @ own), share * x))
        if mass and payload.center_of_mass_m is not None and not moments:
            found += [
                (mass * payload.center_half_width_m * self.whole[:, i], np.zeros(len(names)))
                for i in MOMENTS
            ]
        return found

    def values(self, estimate: Estimate) -> Array:
        """Return the base parameters (b,) of the payload by an estimate."""
        return self.known + self.columns @ estimate.values_of(self.names)

    def nearest_body(self, phi: Array, covariance: Array | None) -> tuple[Array, Array, Bools]:
        """Find the rigid body with positive mass density nearest to phi_f.

        Parameters
        ----------
        phi : (f,) estimate of phi_f.
        covariance : (f, f) of the estimate; None for a ball with the known values.

        Returns
        -------
        XX XY XZ YY YZ ZZ MX MY MZ M (10,), their standard errors, and a mask of the values that
        mainly follow from the prior, a ball.
        """
        given = {payload_parameter(name): x for name, x in zip(self.names, phi, strict=True)}
        by_place = [given.get(name, x) for name, x in zip(LINK, self.fixed, strict=True)]
        stated, not_found = np.flatnonzero(self.fixed), (np.zeros(10), np.ones(10, dtype=bool))
        mass = self.payload.mass_kg or (by_place[MASS] if by_place[MASS] > 0 else 1.0)
        x, y, z = (float(by_place[i] / mass) for i in MOMENTS)
        try:
            ball = payload_parameters(self.model, Payload(mass, (x, y, z)))
            if covariance is None or not len(phi):
                return np.where(self.fixed != 0, self.fixed, ball), *not_found
            K = np.concatenate([self.grouping, np.eye(len(LINK))[stated]])
            sd = np.maximum(KNOWN_SHARE * np.abs(self.fixed[stated]), 1e-9)
            C = np.diag(np.r_[np.full(len(phi), 1e-12), sd**2])
            C[: len(phi), : len(phi)] = covariance
            body = PhysicalParameters(
                links=np.arange(len(LINK))[None],
                prior=pseudo_inertia(ball[None]),
                combinations=np.zeros((0, len(LINK))),
                start=ball,
            )
            found = consistent_parameters(np.r_[phi, self.fixed[stated]], C, K, body)
            (sigma, share), _ = parameter_certainty(found, C, K, body)
        # No rigid body is near the estimate: only the known values are left.
        except (NoFitError, np.linalg.LinAlgError):
            return self.fixed, *not_found
        return found.chi, sigma, share > PRIOR_SHARE


def payload_columns(
    problems: Sequence[Problem], labels: Sequence[str], *, scale: bool
) -> list[PayloadColumns | None]:
    """Return the payload of each recording, None for none.

    Equal payloads have the same parameters. A centre of mass given with a half-width is estimated,
    unless the mass alone would not determine the `scale` of drive gains. If every recording has a
    payload, the unknown part of the lightest is left out: the base parameters are those of the
    robot with it.
    """
    payloads, found = (
        [problem.signals.payload for problem in problems],
        dict[Payload, PayloadColumns](),
    )
    stated, lightest = [payload for payload in payloads if payload is not None], None
    if len(stated) == len(payloads):
        lightest = min(stated, key=lambda one: np.inf if one.mass_kg is None else one.mass_kg)
    for problem, payload, label in zip(problems, payloads, labels, strict=True):
        if payload is not None and payload not in found:
            found[payload] = _columns(
                problem, payload, label, estimated=payload != lightest, scale=scale
            )
    return [None if payload is None else found[payload] for payload in payloads]


def _columns(
    problem: Problem, payload: Payload, label: str, *, estimated: bool, scale: bool
) -> PayloadColumns:
    model, base, fixed = problem.model, problem.base, np.zeros(len(LINK))
    P, known = base.K[:, link_columns(model)[-1]], list[int]()
    if payload.mass_kg is not None:
        known = [MASS, *(MOMENTS if payload.center_of_mass_m is not None else ())]
        fixed[known] = payload_parameters(model, payload)[known]
    places = _independent(P, [i for i in ORDER if i not in known]) if estimated else []
    if estimated and len(known) > 1 and payload.center_half_width_m > 0:
        # Given moments come last, so that no other parameter is regrouped into them.
        free = _independent(P, [*places, *MOMENTS])
        if not scale or MASS in _independent(P, [*free, MASS]):
            known, places = [i for i in known if i not in free], free
            fixed[free] = 0.0
    grouping: Array = (
        np.asarray(np.linalg.lstsq(P[:, places], P)[0]) if places else np.zeros((0, len(LINK)))
    )
    grouping[np.abs(grouping) < TOLERANCE] = 0.0
    grouping[:, known] = 0.0
    return PayloadColumns(
        payload=payload,
        model=model,
        names=tuple(
            payload_name(LINK[place] + "R" * bool(np.count_nonzero(row) > 1), label)
            for place, row in zip(places, grouping, strict=True)
        ),
        grouping=grouping,
        fixed=fixed,
        known=P @ fixed,
        columns=P[:, places],
        whole=P,
    )


def _independent(P: Array, places: Sequence[int]) -> list[int]:
    """Return the `places` whose columns are not a combination of the ones before."""
    found, basis = list[int](), np.zeros((len(P), 0))
    for place in places:
        rest = P[:, place] - basis @ (basis.T @ P[:, place])
        if np.linalg.norm(rest) > TOLERANCE * np.abs(P).max():
            found.append(place)
            basis = np.linalg.qr(P[:, found])[0]
    return found
