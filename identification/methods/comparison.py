"""Two sets of parameters side by side: least squares and instrumental variables, a fit and the truth, two fits."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import msgspec
from msgspec import UNSET, UnsetType

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Estimate, Intervals
from ..model import BaseParameters
from ..regression import base_name
from ..report import Document, Number, ResultFile, Row, Section, Table, columns, document_json, value_form
from .fit import Fit

PER_INTERVAL = 1.96  # deviations in half a 95 % interval


class Parameter(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter with its 95 % interval and its deviation `sigma` by the formula, 0 where the value is known exactly.

    `low`, `high` and `expression`, what it stands for, are None in a file of an earlier version.
    """

    name: str
    value: float
    low: float | None = None
    high: float | None = None
    unit: str
    expression: str | None = None
    sigma: float = 0.0
    sigma_hac: float | UnsetType | None = UNSET  # of a file of an earlier version
    essential: bool = False

    @property
    def half(self) -> float:
        """Half the 95 % interval; without one, 1.96 deviations, the larger of the two."""
        if self.low is None or self.high is None:
            return PER_INTERVAL * max(self.sigma, self.sigma_hac or 0.0)
        return 0.5 * (self.high - self.low)

    @property
    def spread(self) -> float:
        """The deviation to judge by, of which 1.96 make half the interval."""
        return self.half / PER_INTERVAL


@dataclass(frozen=True, kw_only=True)
class ParameterSet:
    """Parameters by name under a label such as `IV`, in the order of the robot's parameters."""

    label: str
    parameters: Mapping[str, Parameter]


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A parameter of two sets; None where one of them has no such parameter.

    `off` is a - b, `off_percent` in percent of b, `off_sigma` in deviations of the difference, taken as independent: beyond
    1.96 the intervals say that the two differ.
    """

    name: str
    unit: str
    a: Parameter | None
    b: Parameter | None
    off: float | None
    off_percent: float | None
    off_sigma: float | None


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


def differences(a: ParameterSet, b: ParameterSet) -> list[Difference]:
    """Two sets of parameters, one by one: those of `a` first, then those that only `b` has.

    Two belong together that stand for the same sum of standard parameters, whatever their names; where one set does not say
    what its parameters stand for, those of the same name. An `IdentificationError` where the two have nothing in common, or a
    parameter in different units.
    """
    partners = _partners(a, b)
    if not partners:
        expected = "two fits of one robot, or of like robots"
        raise IdentificationError("no parameter in common", place=f"{a.label} and {b.label}", expected=expected)
    rows = []
    for name, x in a.parameters.items():
        y = b.parameters[partners[name]] if name in partners else None
        if y is None:
            rows.append(_alone(name, a=x))
            continue
        if x.unit != y.unit:
            expected = f"{x.unit}, as in {a.label}"
            raise IdentificationError(place=b.label, key=f"{name}.unit", value=y.unit, expected=expected)
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


def _alone(name: str, *, a: Parameter | None = None, b: Parameter | None = None) -> Difference:
    unit = a.unit if a else b.unit if b else ""
    return Difference(name=name, unit=unit, a=a, b=b, off=None, off_percent=None, off_sigma=None)


def _have_expressions(*sets: ParameterSet) -> bool:
    return all(value.expression is not None for values in sets for value in values.parameters.values())


def _partners(a: ParameterSet, b: ParameterSet) -> dict[str, str]:
    """By name in `a`, the name in `b` of the parameter that stands for the same.

    One that a recording has for itself stands beside the same recording's, or beside the one that recordings share.
    """
    if not _have_expressions(a, b):
        return {name: name for name in a.parameters if name in b.parameters}
    named = {(value.expression, name.removeprefix(base_name(name))): name for name, value in b.parameters.items()}
    found = {
        name: named.get((x.expression, name.removeprefix(base_name(name))), named.get((x.expression, "")))
        for name, x in a.parameters.items()
    }
    return {name: partner for name, partner in found.items() if partner is not None}


def difference_lines(a: ParameterSet, b: ParameterSet, rows: list[Difference]) -> list[str]:
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


def comparison_document(a: ParameterSet, b: ParameterSet, warnings: tuple[str, ...] = ()) -> Document:
    """Two sets of parameters side by side, with `warnings` about them.

    Raises `IdentificationError`: as `differences` does.
    """
    compared = comparison_section(a, b)
    return Document(title=compared.title, sections=(replace(compared, title="", warnings=warnings),))


def comparison_section(a: ParameterSet, b: ParameterSet) -> Section:
    """Two sets of parameters side by side, as a section, each with half its 95 % interval."""
    rows = differences(a, b)
    numbers = (a.label, "±95%", b.label, "±95%", "off by", "%", "in sigma")
    return Section(
        title=f"{a.label} and {b.label}",
        table=Table(columns=columns("name", "unit", numbers=numbers), rows=tuple(_cells(row) for row in rows)),
        lines=tuple(difference_lines(a, b, rows)),
    )


def _cells(row: Difference) -> Row:
    known = [x.spread for x in (row.a, row.b) if x is not None and x.spread > 0]
    form = value_form(min(known, default=0.0))
    values = [number for x in (row.a, row.b) for number in ((x.value, x.half) if x else (None, None))]
    return (
        row.name,
        row.unit,
        *(Number(x, form) for x in values),
        Number(row.off, f"+{form}"),
        Number(row.off_percent, "+.1f", most=1000),
        Number(row.off_sigma, "+.2f"),
    )


class ComparisonFile(ResultFile, frozen=True, kw_only=True):
    """The JSON file of a comparison: two labels, and parameter by parameter what differs."""

    a: str
    b: str
    differences: list[Difference]


def comparison_file(a: ParameterSet, b: ParameterSet, report: Document) -> ComparisonFile:
    """A comparison as it goes into its JSON file, with its `report`."""
    return ComparisonFile(a=a.label, b=b.label, differences=differences(a, b), report=document_json(report))
