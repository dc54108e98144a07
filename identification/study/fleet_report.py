"""Results of a fleet: the Parquet table, control charts of drift, the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import msgspec
import numpy as np

from acquisition.files import atomic_write

from ..arrays import Array
from ..report import Document, Number, Section, Table, columns
from .fleet import Row, Value

MIN_FITS = 5  # fits for control limits
LIMIT_PER_RANGE = 3 / 1.128  # 3 deviations, d2 = 1.128: the mean moving range of two normal values in deviations
ERROR = "moving error"
_TEXTS = ("folder", "file", "sha256", "robot", "method", "status", "verdict", "reason")
_ERRORS = ("error_percent", "moving_error_percent", "standing_error_percent")


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows as a Parquet file, whole or not at all.

    Columns: `folder`, `file`, `sha256`, `start` (UTC), `robot`, `method`, `status`, `verdict`, `reason`; `error_percent`,
    `moving_error_percent`, `standing_error_percent`; per parameter its name, name_low and name_high, with the `unit` in the
    metadata of the column. Missing values are null.
    """
    import pyarrow
    import pyarrow.parquet

    fields = [pyarrow.field(name, pyarrow.string()) for name in _TEXTS]
    fields.insert(3, pyarrow.field("start", pyarrow.timestamp("us", tz="UTC")))
    fields += [pyarrow.field(name, pyarrow.float64()) for name in _ERRORS]
    units = {name: value.unit for row in rows for name, value in row.parameters.items()}
    for name, unit in units.items():
        metadata = {"unit": unit}
        fields += [pyarrow.field(f"{name}{end}", pyarrow.float64(), metadata=metadata) for end in ("", "_low", "_high")]
    cells = [msgspec.structs.asdict(row) for row in rows]
    for cell, row in zip(cells, rows, strict=True):
        for name, value in row.parameters.items():
            cell |= {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}
    table = pyarrow.Table.from_pylist(cells, schema=pyarrow.schema(fields))
    with atomic_write(path) as partial:
        pyarrow.parquet.write_table(table, partial)


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlChart:
    """A parameter, or the error of moving rows in %, of k fits over time.

    Attributes:
        t_s: (k,) seconds from the first fit; `x`: values; `low`, `high`: their 95 % intervals, or NaN.
        limits: centre, lower and upper control limit; None for too few fits.
    """

    name: str
    unit: str
    files: tuple[str, ...]
    t_s: Array
    x: Array
    low: Array
    high: Array
    limits: tuple[float, float, float] | None

    @property
    def outside(self) -> list[int]:
        """Indices of the fits outside the control limits."""
        if self.limits is None:
            return []
        _, lower, upper = self.limits
        return [int(k) for k in np.flatnonzero((self.x < lower) | (self.x > upper))]


@dataclass(frozen=True, kw_only=True, eq=False)
class Drift:
    """The charts of a robot in a folder: the error of moving rows first, then its parameters.

    `rows` are charted: fits with a known start whose verdict is not `do not use`.
    """

    name: str
    rows: tuple[Row, ...]
    charts: tuple[ControlChart, ...]


def control_limits(x: Array) -> tuple[float, float, float] | None:
    """Centre, lower and upper limit of a chart of individual values x (k,), by their mean moving range.

    Mean ± 3 MR / d2, MR the mean of |x[i] - x[i - 1]|, d2 = 1.128 (Shewhart; ISO 7870-2:2013, charts for individuals): the
    moving range grows little if the mean drifts. None for fewer than `MIN_FITS` values.
    """
    if len(x) < MIN_FITS:
        return None
    centre, half = float(x.mean()), LIMIT_PER_RANGE * float(np.abs(np.diff(x)).mean())
    return centre, centre - half, centre + half


def drifts(rows: Sequence[Row]) -> list[Drift]:
    """Charts by folder and robot, with rows ordered by start."""
    series: dict[tuple[str, str], list[tuple[datetime, Row]]] = {}
    for row in rows:
        if row.is_fitted and row.verdict != "do not use" and row.start is not None:
            series.setdefault((row.folder, row.robot), []).append((row.start, row))
    found = []
    for (folder, robot), fits in series.items():
        fits.sort(key=lambda fit: (fit[0], fit[1].file))
        t_s = np.array([(start - fits[0][0]).total_seconds() for start, _ in fits])
        charted = tuple(row for _, row in fits)
        errors = {
            k: Value(value=row.moving_error_percent, low=None, high=None, unit="%")
            for k, row in enumerate(charted)
            if row.moving_error_percent is not None
        }
        charts = [_chart(ERROR, errors, t_s, charted)]
        for name in dict.fromkeys(name for row in charted for name in row.parameters):
            values = {k: row.parameters[name] for k, row in enumerate(charted) if name in row.parameters}
            charts.append(_chart(name, values, t_s, charted))
        found.append(Drift(name=f"{robot}, {folder}", rows=charted, charts=tuple(charts)))
    return found


def _chart(name: str, values: Mapping[int, Value], t_s: Array, rows: Sequence[Row]) -> ControlChart:
    """The chart of a value, by the index of its row."""
    x, low, high = (
        np.array([getattr(v, key) for v in values.values()], dtype=np.float64) for key in ("value", "low", "high")
    )
    return ControlChart(
        name=name,
        unit=next((value.unit for value in values.values()), ""),
        files=tuple(rows[k].file for k in values),
        t_s=t_s[list(values)],
        x=x,
        low=low,
        high=high,
        limits=control_limits(x),
    )


def fleet_document(rows: Sequence[Row]) -> Document:
    """The report: a line per recording, and the values outside their control limits."""
    shown = tuple(
        (
            row.start.strftime("%Y-%m-%d %H:%M") if row.start else "-",
            row.file,
            row.status,
            row.verdict or "-",
            Number(row.moving_error_percent, ".3g"),
            Number(row.error_percent, ".3g"),
        )
        for row in rows
    )
    head = columns("start, UTC", "recording", "status", "verdict", numbers=("moving error %", "error %"))
    reasons = tuple(f"{row.file}: {row.status}: {row.reason}" for row in rows if row.reason)
    recordings = Section(table=Table(columns=head, rows=shown), warnings=reasons)
    return Document(
        title=f"recordings: {len(rows)}, fitted: {sum(row.is_fitted for row in rows)}",
        sections=(recordings, *map(_drift_section, drifts(rows))),
    )


def _drift_section(drift: Drift) -> Section:
    title = f"drift: {drift.name}"
    if len(drift.rows) < MIN_FITS:
        few = f"fits in the charts: {len(drift.rows)}; control limits need {MIN_FITS}"
        return Section(title=title, lines=(few,))
    rows = tuple(
        (
            chart.name,
            Path(chart.files[k]).name,
            Number(float(chart.x[k]), ".5g"),
            Number(chart.limits[1], ".5g"),
            Number(chart.limits[2], ".5g"),
            chart.unit,
        )
        for chart in drift.charts
        if chart.limits is not None
        for k in chart.outside
    )
    text = f"{len(drift.charts)} charts of {len(drift.rows)} fits; limits: mean ± 3 sigma from the mean moving range"
    if not rows:
        return Section(title=title, lines=(text, "no value is outside its control limits"))
    head = columns("of", "recording", numbers=("value", "lower", "upper")) + columns("unit")
    return Section(title=title, table=Table(columns=head, rows=rows), lines=(text,))
