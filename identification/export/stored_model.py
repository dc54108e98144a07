"""A fit's JSON file as a robot with values for all standard parameters; one that is not consistent is made so."""

from dataclasses import dataclass

import numpy as np
from msgspec import UNSET

from acquisition.robot import Robot

from ..arrays import Array
from ..errors import IdentificationError
from ..methods import Known, Prior, consistent_set, refuse_unknown_gain, stored_beta, stored_robot
from ..model import InverseModel, base_parameters
from ..report import FitFile
from .mechanism import Mechanism, mechanism_of


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredModel:
    """The mechanism of a fit, and lines that say where its values are from."""

    mechanism: Mechanism
    lines: tuple[str, ...]

    @property
    def robot(self) -> Robot:
        """As the fit's own description has it."""
        return self.mechanism.model.robot


def distrust(stored: FitFile, place: str) -> list[str]:
    """Why a fit is not to be trusted; a file without a verdict, of an earlier version, by its status and doubts."""
    if stored.verdict is UNSET:
        return stored.warnings_of(place)
    return [f"{place}: verdict {stored.verdict}"] if stored.verdict == "do not use" else []


def model_of_fit(stored: FitFile, place: str) -> StoredModel:
    """The robot of a fit, which its own description describes, with values for all standard parameters.

    An `IdentificationError`, with the file's `place`, for a fit in A or V, without a description or a covariance, or whose
    parameters no robot can have.
    """
    robot = stored_robot(stored, place)
    if robot is None:
        expected = "a fit as `robot-identify fit --json` writes it"
        raise IdentificationError(place=place, key="description", value=None, expected=expected)
    refuse_unknown_gain(robot)
    model = InverseModel(robot)
    if stored.standard_parameters is UNSET:
        chi, lines = _made_consistent(stored, model, place)
    else:
        chi, lines = _standard(stored, model, place), _of_consistent(stored, place)
    return StoredModel(mechanism=mechanism_of(model, chi, place), lines=lines)


def _standard(stored: FitFile, model: InverseModel, place: str) -> Array:
    given = stored.standard_parameters or []
    found = [(p.name, p.unit) for p in given]
    expected = list(zip(model.names, model.units, strict=True))
    if found != expected:
        other = next((f"{a[0]} in {a[1]}" for a in found if a not in expected), None)
        wanted = f"those of the description: {len(expected)}"
        raise IdentificationError(place=place, key="standard_parameters", value=other, expected=wanted)
    return np.array([p.value for p in given])


def _of_consistent(stored: FitFile, place: str) -> tuple[str, ...]:
    c = stored.consistent
    if c is UNSET:
        return ()
    return (
        f"the consistent parameters of {place}: prior {c.prior}, weight {c.prior_weight:g}; chi² {c.chi2:.3g}, largest move "
        f"{c.largest_move:.2g} half-widths of the 95 % interval, of {c.moved_most}",
    )


def _made_consistent(stored: FitFile, model: InverseModel, place: str) -> tuple[Array, tuple[str, ...]]:
    base = base_parameters(model)
    beta = stored_beta(stored, base, place)
    if stored.covariance is UNSET:
        problem = "the fit is not consistent, and cannot be made so without it"
        expected = "a fit of this version, best with --consistent"
        raise IdentificationError(problem, place=place, key="covariance", value=None, expected=expected)
    names, values = stored.covariance.names, np.array(stored.covariance.values)
    own = [name for name in names if name not in base.names]
    if own:
        problem = "of single recordings: the fit is not consistent, and cannot be made so with them"
        expected = "the fit again with --consistent"
        raise IdentificationError(problem, place=place, key="covariance", value=", ".join(own[:5]), expected=expected)
    left_out = {p.name: p.sigma for p in stored.left_out or ()}
    missing = [name for name in base.names if name not in names and name not in left_out]
    if missing or values.shape != (len(names), len(names)):
        raise IdentificationError(
            place=place, key="covariance", value=", ".join(missing[:5]) or None, expected="one row per parameter"
        )
    at = [base.names.index(name) for name in names]
    covariance = np.diag([left_out.get(name, 0.0) ** 2 for name in base.names])
    covariance[np.ix_(at, at)] = values
    sigma = dict(zip(names, np.sqrt(np.diag(values)), strict=True))
    reach = float(np.median([p.half / sigma[p.name] for p in stored.parameters if sigma.get(p.name)] or [1.0]))
    c = consistent_set(model, base, Known(beta=beta, covariance=covariance, reach=reach), prior=Prior())
    line = (
        f"{place} is not consistent: the nearest consistent parameters are taken; prior {c.prior}; "
        f"added chi² {c.chi_squared:.3g} on {base.b} parameters, largest move {c.largest_move:.2g} half-widths of the 95 % "
        f"interval, of {c.moved_most}; certificate {c.certificate:.1e}"
    )
    return c.chi, (line,)
