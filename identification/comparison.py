"""Two sets of parameters side by side: least squares and instrumental variables, a fit and the truth, two fits."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from . import IdentificationError
from .fit import Fit
from .fit_file import StoredFit

Vector = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Value:
    """A parameter's value; `sigma` is 0 where it is known exactly, `sigma_hac` None where it is not known."""

    value: float
    sigma: float
    sigma_hac: float | None
    unit: str
    essential: bool

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
    units = dict(zip(fit.base.names, fit.base.units, strict=True))
    return Values(
        label={"iv": "IV", "wls": "LS", "ols": "OLS"}[fit.method],
        parameters={
            name: Value(
                value=float(value),
                sigma=float(sigma),
                sigma_hac=float(hac) if math.isfinite(hac) else None,
                unit=units[name],
                essential=name in essential,
            )
            for name, value, sigma, hac in zip(e.names, e.beta, e.sigma, fit.sigma_hac, strict=True)
        },
    )


def true_values(fit: Fit, truth: Vector) -> Values:
    """Known base parameters (b,) in the order of the fit's base."""
    return Values(
        label="true",
        parameters={
            name: Value(value=float(value), sigma=0.0, sigma_hac=None, unit=unit, essential=False)
            for name, value, unit in zip(fit.base.names, truth, fit.base.units, strict=True)
        },
    )


def values_of_stored(stored: StoredFit, label: str) -> Values:
    """The parameters of a fit's JSON file."""
    return Values(
        label=label,
        parameters={
            p.name: Value(value=p.value, sigma=p.sigma, sigma_hac=p.sigma_hac, unit=p.unit, essential=p.essential)
            for p in stored.parameters
        },
    )


def differences(a: Values, b: Values) -> list[Difference]:
    """Parameter by parameter, those of `a` first, then those that only `b` has.

    Raises `IdentificationError` where the two have nothing in common, or a parameter in different units.
    """
    if not set(a.parameters) & set(b.parameters):
        raise IdentificationError(
            f"{a.label} and {b.label} have no parameter in common: expected two fits of one robot, or of like robots"
        )
    rows = []
    for name in (*a.parameters, *(name for name in b.parameters if name not in a.parameters)):
        x, y = a.parameters.get(name), b.parameters.get(name)
        if x is None or y is None:
            unit = x.unit if x else y.unit if y else ""
            rows.append(Difference(name=name, unit=unit, a=x, b=y, off=None, off_percent=None, off_sigma=None))
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
    return rows


def difference_lines(a: Values, b: Values, rows: list[Difference]) -> list[str]:
    """The comparison in words."""
    off = [abs(row.off_sigma) for row in rows if row.off_sigma is not None]
    lines = []
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


def difference_table(a: Values, b: Values) -> RenderableType:
    """Two sets of parameters for the terminal; sigma is the larger of its two deviations."""
    rows = differences(a, b)
    table = Table(title=Text(f"{a.label} and {b.label}"), title_justify="left")
    for column in ("name", "unit"):
        table.add_column(column)
    for values in (a, b):
        table.add_column(Text(values.label), justify="right")
        table.add_column("sigma", justify="right")
    for column in ("off by", "%", "in sigma"):
        table.add_column(column, justify="right")
    for row in rows:
        known = [x.spread for x in (row.a, row.b) if x is not None and x.spread > 0]
        d = max(4, min(12, 2 - math.floor(math.log10(min(known))))) if known else 4
        cells = [(f"{x.value:.{d}f}", f"{x.spread:.{d}f}") if x else ("-", "-") for x in (row.a, row.b)]
        table.add_row(
            Text(row.name),
            Text(row.unit),
            *(cell for pair in cells for cell in pair),
            "-" if row.off is None else f"{row.off:+.{d}f}",
            "-" if row.off_percent is None else f"{row.off_percent:+.1f}" if abs(row.off_percent) < 1000 else "> 1000",
            "-" if row.off_sigma is None else f"{row.off_sigma:+.2f}",
        )
    return Group(table, *(Text(line) for line in difference_lines(a, b, rows)))
