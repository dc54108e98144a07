"""Two sets of parameters side by side: least squares and instrumental variables, a fit and the truth, two fits."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import IdentificationError
from ..methods import Fit
from .document import Document, Number, Row, Section, Table, columns, value_form
from .fit_file import StoredFit

Vector = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Value:
    """A parameter's value; `sigma` is 0 where it is known exactly, `sigma_hac` None where it is not known.

    `expression` says what it stands for, None in a file of an earlier version.
    """

    value: float
    sigma: float
    sigma_hac: float | None
    unit: str
    essential: bool
    expression: str | None = None

    @property
    def spread(self) -> float:
        """The deviation to judge by: the larger of the two."""
        return max(self.sigma, self.sigma_hac or 0.0)


@dataclass(frozen=True, kw_only=True)
class Values:
    """Parameters by name under a label such as `IV`, in the order of the robot's parameters."""

    label: str
    parameters: Mapping[str, Value]


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A parameter of two sets; None where one of them has no such parameter.

    `off` is a - b, `off_percent` in percent of b, `off_sigma` in deviations of the difference, taken as independent.
    """

    name: str
    unit: str
    a: Value | None
    b: Value | None
    off: float | None
    off_percent: float | None
    off_sigma: float | None


def values_of_fit(fit: Fit) -> Values:
    """The parameters a fit estimated."""
    e, essential = fit.estimate, set(fit.essential.estimate.names)
    known = dict(zip(fit.base.names, zip(fit.base.units, fit.base.expressions, strict=True), strict=True))
    return Values(
        label={"iv": "IV", "wls": "LS", "ols": "OLS"}[fit.method],
        parameters={
            name: Value(
                value=float(value),
                sigma=float(sigma),
                sigma_hac=float(hac) if math.isfinite(hac) else None,
                unit=known[name][0],
                essential=name in essential,
                expression=known[name][1],
            )
            for name, value, sigma, hac in zip(e.names, e.beta, e.sigma, fit.sigma_hac, strict=True)
        },
    )


def true_values(fit: Fit, truth: Vector) -> Values:
    """Known base parameters (b,) in the order of the fit's base."""
    return Values(
        label="true",
        parameters={
            name: Value(value=float(x), sigma=0.0, sigma_hac=None, unit=unit, essential=False, expression=expression)
            for name, x, unit, expression in zip(
                fit.base.names, truth, fit.base.units, fit.base.expressions, strict=True
            )
        },
    )


def values_of_stored(stored: StoredFit, label: str) -> Values:
    """The parameters of a fit's JSON file."""
    return Values(
        label=label,
        parameters={
            p.name: Value(
                value=p.value,
                sigma=p.sigma,
                sigma_hac=p.sigma_hac,
                unit=p.unit,
                essential=p.essential,
                expression=p.expression,
            )
            for p in stored.parameters
        },
    )


def differences(a: Values, b: Values) -> list[Difference]:
    """Parameter by parameter, those of `a` first, then those that only `b` has.

    Two belong together that stand for the same sum of standard parameters, whatever their names; where one set does not say
    what its parameters stand for, those of the same name.
    Raises `IdentificationError` where the two have nothing in common, or a parameter in different units.
    """
    partners = _partners(a, b)
    if not partners:
        raise IdentificationError(
            f"{a.label} and {b.label} have no parameter in common: expected two fits of one robot, or of like robots"
        )
    rows = []
    for name, x in a.parameters.items():
        y = b.parameters[partners[name]] if name in partners else None
        if y is None:
            rows.append(_alone(name, a=x))
            continue
        if x.unit != y.unit:
            raise IdentificationError(f"{name} is in {x.unit} in {a.label} and in {y.unit} in {b.label}")
        off, sigma = x.value - y.value, math.hypot(x.spread, y.spread)
        rows.append(
            Difference(
                name=name,
                unit=x.unit,
                a=x,
                b=y,
                off=off,
                off_percent=100 * off / abs(y.value) if y.value else None,
                off_sigma=off / sigma if sigma > 0 else None,
            )
        )
    for name in b.parameters:
        if name not in partners.values():
            rows.append(_alone(f"{name} of {b.label}" if name in a.parameters else name, b=b.parameters[name]))
    return rows


def _alone(name: str, *, a: Value | None = None, b: Value | None = None) -> Difference:
    unit = a.unit if a else b.unit if b else ""
    return Difference(name=name, unit=unit, a=a, b=b, off=None, off_percent=None, off_sigma=None)


def _have_expressions(*sets: Values) -> bool:
    return all(value.expression is not None for values in sets for value in values.parameters.values())


def _partners(a: Values, b: Values) -> dict[str, str]:
    """By name in `a`, the name in `b` of the parameter that stands for the same."""
    if not _have_expressions(a, b):
        return {name: name for name in a.parameters if name in b.parameters}
    named = {value.expression: name for name, value in b.parameters.items()}
    return {name: named[x.expression] for name, x in a.parameters.items() if x.expression in named}


def frame_lines(a: StoredFit, b: StoredFit, labels: tuple[str, str]) -> list[str]:
    """A line where the link frames of two fits differ: equal names then stand for different quantities."""
    robots = [fit.robot(label) for fit, label in zip((a, b), labels, strict=True)]
    if any(robot is None for robot in robots):
        return []
    told = ["a URDF" if robot and robot.urdf is not None else "DH rows" for robot in robots]
    frames = [(robot.urdf, tuple(joint.dh for joint in robot.joints)) for robot in robots if robot]
    if frames[0] == frames[1]:
        return []
    which = f"{labels[0]} has {told[0]}, {labels[1]} {told[1]}" if told[0] != told[1] else f"two different {told[0]}"
    if told[0] == told[1] == "a URDF":
        which = "two different URDFs"
    return [
        f"the link frames differ: {which}; parameters of links (XX to M) compare only where a link has the same frame in both"
    ]


def difference_lines(a: Values, b: Values, rows: list[Difference]) -> list[str]:
    """The comparison in words."""
    named = (
        []
        if _have_expressions(a, b)
        else ["parameters matched by name: a file of an earlier version has no expressions"]
    )
    off = [abs(row.off_sigma) for row in rows if row.off_sigma is not None]
    lines = named
    if off:
        worst = max((row for row in rows if row.off_sigma is not None), key=lambda row: abs(row.off_sigma or 0.0))
        shares = ", ".join(f"{sum(x <= k for x in off)} within {k} sigma" for k in (1, 2, 3))
        lines.append(
            f"of {len(off)} parameters in both {shares}; furthest apart {worst.name} by {abs(worst.off_sigma or 0):.2g}"
        )
    for values, missing in ((a, [r.name for r in rows if r.b is None]), (b, [r.name for r in rows if r.a is None])):
        if missing:
            lines.append(f"only in {values.label}: {', '.join(missing)}")
    return lines


def comparison_document(a: Values, b: Values, warnings: tuple[str, ...] = ()) -> Document:
    """Two sets of parameters side by side. Raises `IdentificationError` as `differences` does."""
    compared = comparison_section(a, b)
    return Document(title=compared.title, sections=(replace(compared, title="", warnings=warnings),))


def comparison_section(a: Values, b: Values) -> Section:
    """Two sets of parameters side by side; sigma is the larger of a set's two deviations."""
    rows = differences(a, b)
    numbers = (a.label, "sigma", b.label, "sigma", "off by", "%", "in sigma")
    return Section(
        title=f"{a.label} and {b.label}",
        table=Table(columns=columns("name", "unit", numbers=numbers), rows=tuple(_cells(row) for row in rows)),
        lines=tuple(difference_lines(a, b, rows)),
    )


def _cells(row: Difference) -> Row:
    known = [x.spread for x in (row.a, row.b) if x is not None and x.spread > 0]
    form = value_form(min(known, default=0.0))
    values = [number for x in (row.a, row.b) for number in ((x.value, x.spread) if x else (None, None))]
    return (
        row.name,
        row.unit,
        *(Number(x, form) for x in values),
        Number(row.off, f"+{form}"),
        Number(row.off_percent, "+.1f", most=1000),
        Number(row.off_sigma, "+.2f"),
    )
