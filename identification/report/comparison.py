"""Comparison of two parameter sets.

The sets are least squares and instrumental variables, a fit and the truth, or two fits.
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace

from acquisition.errors import BadInputError, Location

from .document import Document, Number, Row, Section, Table, columns, value_form
from .fit_file import FitFile
from .parameters import Parameter, recording_of


@dataclass(frozen=True, kw_only=True)
class ParameterSet:
    """Parameters by name under a label such as `IV`, in the order of the robot's parameters."""

    label: str
    parameters: Mapping[str, Parameter]

    @classmethod
    def of_file(cls, stored: FitFile, label: str) -> "ParameterSet":
        """Return the parameters of a fit's file."""
        return cls(label=label, parameters={p.name: p for p in stored.parameters})


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A parameter of two sets; None where one of them has no such parameter.

    `off` is a - b, `off_percent` in percent of b, `off_sigma` in standard errors of the difference
    of independent values: above 1.96 the difference is significant.
    """

    name: str
    unit: str
    a: Parameter | None = None
    b: Parameter | None = None
    off: float | None = None
    off_percent: float | None = None
    off_sigma: float | None = None

    @property
    def spread(self) -> float:
        """The smaller standard error of the two parameters; 0 if both are exact."""
        return min((x.spread for x in (self.a, self.b) if x and x.spread > 0), default=0.0)


def differences(a: ParameterSet, b: ParameterSet) -> list[Difference]:
    """Return the differences by parameter: those of `a` first, then those that only `b` has.

    Parameters are matched by their expressions in standard parameters; without expressions, by
    name.

    Raises
    ------
    BadInputError : the two have nothing in common, or a parameter has different units.
    """
    partners = _partners(a, b)
    Location(f"{a.label} and {b.label}").require(
        partners,
        text="no parameter in common",
        expected="two fits of one robot, or of like robots",
    )
    for name, partner in partners.items():
        x, y = a.parameters[name], b.parameters[partner]
        Location(b.label).require(
            x.unit == y.unit, f"{name}.unit", y.unit, f"{x.unit}, as in {a.label}"
        )
    return [
        *(
            _difference(name, x, b.parameters[partners[name]])
            if name in partners
            else Difference(name=name, unit=x.unit, a=x)
            for name, x in a.parameters.items()
        ),
        *(
            Difference(
                name=f"{name} of {b.label}" if name in a.parameters else name, unit=y.unit, b=y
            )
            for name, y in b.parameters.items()
            if name not in partners.values()
        ),
    ]


def _difference(name: str, x: Parameter, y: Parameter) -> Difference:
    off, sigma = x.value - y.value, math.hypot(x.spread, y.spread)
    return Difference(
        name=name,
        unit=x.unit,
        a=x,
        b=y,
        off=off,
        off_percent=100 * off / abs(y.value) if y.value else None,
        off_sigma=off / sigma if sigma > 0 else None,
    )


def _have_expressions(*sets: ParameterSet) -> bool:
    return all(
        value.expression is not None for values in sets for value in values.parameters.values()
    )


def _partners(a: ParameterSet, b: ParameterSet) -> dict[str, str]:
    """Return the names in `b` of the parameters in `a`.

    A per-recording parameter matches that of the same recording, or else the shared one.
    """
    if not _have_expressions(a, b):
        return {name: name for name in a.parameters if name in b.parameters}
    named = {(value.expression, recording_of(name)): name for name, value in b.parameters.items()}
    shared = {
        name: named.get((x.expression, recording_of(name)), named.get((x.expression, "")))
        for name, x in a.parameters.items()
    }
    return {name: partner for name, partner in shared.items() if partner}


def difference_lines(a: ParameterSet, b: ParameterSet, rows: list[Difference]) -> list[str]:
    """Describe the comparison in words."""
    lines = (
        []
        if _have_expressions(a, b)
        else ["Parameters are matched by name: a file of an earlier version has no expressions."]
    )
    off = {row.name: abs(row.off_sigma) for row in rows if row.off_sigma is not None}
    if off:
        worst = max(off, key=lambda name: off[name])
        shares = ", ".join(f"{sum(x <= k for x in off.values())} within {k}" for k in (1, 2, 3))
        lines.append(
            f"Of {len(off)} parameters in both, {shares} standard errors. Largest difference: "
            f"{worst} by {off[worst]:.2g} standard errors."
        )
    return lines + [
        f"Only in {label}: {', '.join(names)}."
        for label, names in (
            (a.label, [row.name for row in rows if row.b is None]),
            (b.label, [row.name for row in rows if row.a is None]),
        )
        if names
    ]


def comparison_document(
    a: ParameterSet, b: ParameterSet, warnings: tuple[str, ...] = (), *, prior: bool = False
) -> Document:
    """Make the report of a comparison with `warnings`.

    The short form has the largest differences in sigma. With a `prior` b the report also has a over
    b.
    """
    section, rows = comparison_section(a, b), differences(a, b)
    if prior:
        both = [
            (row, row.a.value / row.b.value if row.b.value else None)
            for row in rows
            if row.a and row.b
        ]
        table = Table(
            columns=columns(
                "name", "unit", numbers=("value", "95 % half-width", "a priori", "ratio")
            ),
            rows=tuple((*_cells(row)[:5], Number(x, ".3g", most=1e6)) for row, x in both),
        )
        section, rows = replace(section, table=table), [row for row, _ in both]
    largest = sorted(range(len(rows)), key=lambda k: -abs(rows[k].off_sigma or 0.0))
    return Document(
        title=section.title,
        sections=(replace(section, title="", warnings=warnings).with_short_table(largest),),
    )


def comparison_section(a: ParameterSet, b: ParameterSet) -> Section:
    """Make the section of a comparison, with half-widths of the 95 % intervals."""
    rows = differences(a, b)
    return Section(
        title=f"{a.label} and {b.label}",
        table=Table(
            columns=columns(
                "name",
                "unit",
                numbers=(
                    *(head for x in (a, b) for head in (x.label, "95 % half-width")),
                    *("difference", "relative, %", "in standard errors"),
                ),
            ),
            rows=tuple(_cells(row) for row in rows),
        ),
        lines=tuple(difference_lines(a, b, rows)),
    )


def _cells(row: Difference) -> Row:
    both, form = (row.a, row.b), value_form(row.spread)
    values = [number for x in both for number in ((x.value, x.half) if x else (None, None))]
    return (
        row.name,
        row.unit,
        *(Number(x, form) for x in values),
        Number(row.off, f"+{form}"),
        Number(row.off_percent, "+.1f", most=1000),
        Number(row.off_sigma, "+.2f"),
    )


def frame_lines(a: FitFile, b: FitFile, labels: tuple[str, str]) -> list[str]:
    """Return a line if the link frames of two fits, named by `labels`, differ.

    Equal names then mean different quantities.
    """
    if not a.description or not b.description:
        return []
    frames = [_frames(fit.description, label) for fit, label in zip((a, b), labels, strict=True)]
    if frames[0] == frames[1]:
        return []
    kinds = ["a URDF" if isinstance(one, str) else "DH rows" for one in frames]
    alike = {"a URDF": "two different URDFs", "DH rows": "two different DH rows"}
    which = (
        alike[kinds[0]]
        if kinds[0] == kinds[1]
        else f"{labels[0]} has {kinds[0]}, {labels[1]} {kinds[1]}"
    )
    return [
        f"the link frames differ: {which}; link parameters (XX to M) are comparable only where a "
        "link has the same frame in both"
    ]


def _frames(description: dict[str, str], place: str) -> str | list[object]:
    """Return the source of the link frames: the URDF's text, or the DH rows."""
    if "robot.urdf" in description:
        return description["robot.urdf"]
    try:
        return [joint["dh"] for joint in tomllib.loads(description["robot.toml"])["joint"]]
    except (tomllib.TOMLDecodeError, KeyError, TypeError) as error:
        raise BadInputError(
            place=place,
            key="description",
            value=str(error),
            expected="the robot.toml that was fitted",
        ) from error
