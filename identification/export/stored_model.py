"""Read a fit's JSON file as a robot with all standard parameters; make it
consistent if it is not.
"""

from pathlib import Path

import numpy as np
from msgspec import UNSET

from acquisition.files import refuse_clash

from ..arrays import Array
from ..errors import BadInputError
from ..model import SHAPES, InverseModel, base_parameters
from ..report import Document, FitFile, Section, base_name
from ..results import Known, consistent_set, refuse_unknown_gain, stored_beta, stored_robot
from .exported_model import ExportedModel, split_parameters
from .exporting import export_model, write_models
from .tables import with_gains, with_law


def export_fit(
    stored: FitFile, place: str, *, untrusted: bool = False, **outputs: Path | None
) -> Document:
    """Write a fit as `urdf`, `mjcf` or `toml`, and report what each format cannot represent.

    Raises `BadInputError`: the fit is not to be used and not allowed as
        `untrusted`; as of `model_of_fit`.
    """
    refuse_clash((), of_kinds=outputs)
    reasons = distrust(stored, place)
    if reasons and not untrusted:
        raise BadInputError(
            f"not exported: {'; '.join(reasons)}",
            expected="a fit to be trusted, or --allow-untrusted",
        )
    mechanism, lines = model_of_fit(stored, place)
    texts, document = export_model(mechanism, Path(place).name, lines=lines, **outputs)
    write_models(texts)
    return document.followed_by(Section(warnings=tuple(reasons))) if reasons else document


def distrust(stored: FitFile, place: str) -> list[str]:
    """Reasons not to trust a fit; in files of earlier versions, without a verdict,
    its status and warnings.
    """
    if stored.verdict is UNSET:
        return stored.warnings_of(place)
    return [f"{place}: verdict {stored.verdict}"] if stored.verdict == "do not use" else []


def model_of_fit(stored: FitFile, place: str) -> tuple[ExportedModel, tuple[str, ...]]:
    """The robot of a fit, by its own description and drive gains, with all standard parameters;
    lines on their origin.
    """
    stored, of_gains = with_gains(stored, place)
    stored, of_law = with_law(stored, place)
    robot = stored_robot(stored, place)
    refuse_unknown_gain(robot)
    model = InverseModel(robot)
    if stored.standard_parameters is UNSET:
        chi, line = _make_consistent(stored, model, place)
        return split_parameters(model, chi, place), (*of_gains, *of_law, line)
    parameters, names = stored.standard_parameters, list(zip(model.names, model.units, strict=True))
    if [(p.name, p.unit) for p in parameters] != names:
        raise BadInputError(
            place=place,
            key="standard_parameters",
            value=next(
                (f"{p.name} in {p.unit}" for p in parameters if (p.name, p.unit) not in names), None
            ),
            expected=f"the {len(names)} of the description",
        )
    lines = [*of_gains, *of_law]
    if (c := stored.consistent) is not UNSET:
        lines.append(
            f"the consistent parameters of {place}: prior {c.prior}, weight "
            f"{c.prior_weight:g}; chi² {c.chi2:.3g}, largest move {c.largest_move:.2g} "
            f"half-widths of the 95 % interval, of {c.moved_most}"
        )
    return split_parameters(model, np.array([p.value for p in parameters]), place), tuple(lines)


def _make_consistent(stored: FitFile, model: InverseModel, place: str) -> tuple[Array, str]:
    left_out = {p.name: p.sigma for p in stored.left_out or ()}
    given, base = {base_name(p.name) for p in stored.parameters}, base_parameters(model)
    # Further friction terms may be left out altogether, which is not to estimate them as zero.
    shapes = {term.name for term in model.terms.values() if term.kind in SHAPES}
    base = base.without(shapes - given - left_out.keys())
    beta = stored_beta(stored, base, place)
    if stored.covariance is UNSET:
        raise BadInputError(
            "the fit is not consistent, and cannot be made so without it",
            place=place,
            key="covariance",
            value=None,
            expected="a new fit, preferably with --consistent",
        )
    names, values = stored.covariance.names, np.array(stored.covariance.values)
    shared = [base_name(name) for name in names]
    missing = [name for name in base.names if name not in shared and name not in left_out]
    if missing or values.shape != (len(names), len(names)):
        raise BadInputError(
            place=place,
            key="covariance",
            value=", ".join(missing[:5]) or None,
            expected="one row per parameter",
        )
    # of parameters of single recordings the mean, as in `stored_beta`
    mean = np.array([[(own == name) / shared.count(own) for own in shared] for name in base.names])
    covariance = (
        np.diag([left_out.get(name, 0.0) ** 2 for name in base.names]) + mean @ values @ mean.T
    )
    sigma = dict(zip(names, np.sqrt(np.diag(values)), strict=True))
    reach = float(
        np.median([p.half / sigma[p.name] for p in stored.parameters if sigma.get(p.name)] or [1.0])
    )
    c, parameters = consistent_set(
        model, base, Known(beta=beta, covariance=covariance, reach=reach)
    )
    return np.array([p.value for p in parameters]), (
        f"{place} is not consistent: the nearest consistent parameters are used; prior {c.prior}; "
        f"added chi² {c.chi2:.3g} on {base.b} parameters, largest move "
        f"{c.largest_move:.2g} half-widths of the 95 % interval, of {c.moved_most}; certificate "
        f"{c.certificate:.1e}"
    )
