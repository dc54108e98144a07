"""Times of rows by any clock → a uniform grid, with a report on the times → a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import Array, Bools, Ints, first_true
from ..errors import Location, holding
from ..files import BLOCK_ROWS, allocate, atomic_write, taken
from ..recording import MAX_STAMP_NS, Header, RecordingWriter, in_gaps
from ..robot import check_recorded_efforts, check_recorded_positions, check_recorded_velocities
from .stamps import MIN_GAP_STEP, row_numbers, rows_in_time, stamps_warning

POSITION = "position"
# Grids outside of these multiples of the rate of the rows give a warning.
MIN_RATE_RATIO, MAX_RATE_RATIO = 0.9, 2.5
MAX_LEFT_OUT = 0.02  # of the rows; a larger share gives a warning
# A gap of more than so many times the rows that are there separates two recordings.
MOST_MISSING = 10.0
MAX_COMPARED_ROWS = 50_000  # rows whose timestamps are compared with the motion
MAX_OVERSAMPLING = 100.0  # times the rate of the rows; a finer grid is a mistake
# The influence of a row on a spline falls to 0.27 per row, so farther rows act by less than
# rounding.
_SPLINE_REACH = 100


@dataclass(frozen=True, kw_only=True)
class TimeReport:
    """Times of rows before any interpolation.

    Attributes:
        rows: number of rows used.
        doubled: duplicate rows left out, equal to the row before in time and all values.
        period_s: median step in s.
        shortest_s: shortest step in s.
        longest_s: longest step in s.
        jitter_s: standard deviation of the steps without gaps in s.
        off: rows left out because their timestamps do not fit the motion.
        gaps: number of steps of more than 1.5 periods.
        missing: rows missing in them.
        grid_hz: rate of the grid to which values were interpolated; None without interpolation.
        clock: origin of the times, such as `timestamps` or `ticks`.
        stamps_off_s: standard deviation of the timestamps about the ticks in s; None without both.
    """

    rows: int
    doubled: int
    period_s: float
    shortest_s: float
    longest_s: float
    jitter_s: float
    gaps: int
    missing: int
    off: int = 0
    grid_hz: float | None = None
    clock: str = "timestamps"
    stamps_off_s: float | None = None

    @property
    def text(self) -> str:
        """The report in one line."""
        parts = [
            f"{self.clock} of {self.rows} rows: steps {1e3 * self.shortest_s:.4g} to "
            f"{1e3 * self.longest_s:.4g} ms, median {1e3 * self.period_s:.4g} ms",
            f"jitter sd {1e3 * self.jitter_s:.4g} ms",
            f"{self.gaps} gaps, {self.missing} rows missing" if self.gaps else "no gaps",
            f"{self.doubled} duplicate rows left out" if self.doubled else "no duplicate rows",
        ]
        more = {
            f"{self.off} rows left out whose {self.clock} do not fit the motion": self.off,
            f"timestamps sd {1e3 * (self.stamps_off_s or 0.0):.4g} ms about the {self.clock}": (
                self.stamps_off_s is not None
            ),
            f"interpolated to {self.grid_hz or 0.0:.9g} Hz": self.grid_hz is not None,
        }
        return ", ".join([*parts, *holding(more)])


@dataclass(frozen=True, kw_only=True, eq=False)
class GridValues:
    """Values on a uniform grid.

    Attributes:
        parts: values (M, n) by name.
        start_s: first time after `first_ns` in s.
        rate_hz: rate in Hz.
        first_ns: time of the first row in ns.
        report: report on the original times.
        warnings: warnings, one line each.
        absent: (M,) values in gaps, which are not written.
    """

    parts: Mapping[str, Array]
    start_s: float
    rate_hz: float
    first_ns: int = 0
    report: TimeReport | None = None
    warnings: tuple[str, ...] = ()
    absent: Bools | None = None

    @property
    def notes(self) -> Mapping[str, str]:
        """The report, for the metadata of a recording."""
        return {} if self.report is None else {"times": self.report.text}

    def stamps_ns(self, place: str) -> Ints:
        """Compute timestamps (M,) in ns, from 0 if they would begin before 0.

        `place` is the name of the source in errors.
        """
        rows = len(self.parts[POSITION])
        start_s = max(0.0, self.start_s)
        Location(place).require(
            start_s + rows / self.rate_hz < MAX_STAMP_NS * 1e-9 and self.rate_hz <= 1e8,
            text=f"{rows} rows at {self.rate_hz} Hz from {start_s} s are too late or too fast",
            expected="at most 68 years and 100 MHz",
        )
        return np.asarray(
            self.first_ns
            + round(start_s * 1e9)
            + np.rint(np.arange(rows) * (1e9 / self.rate_hz)).astype(np.int64)
        )


def with_warnings(
    grid: GridValues, time_s: Array, q: Array, clock: str, way_out: str
) -> GridValues:
    """Add `clock` and the warnings about times (N,) of positions q (N, n) to a grid."""
    assert grid.report is not None
    report = replace(grid.report, clock=clock)
    growing = np.flatnonzero(np.diff(time_s, prepend=-np.inf) > 0)[:MAX_COMPARED_ROWS]
    found = (*rate_warnings(report), stamps_warning(time_s[growing], q[growing], way_out))
    return replace(grid, report=report, warnings=tuple(filter(None, found)))


def time_report(time_s: Array, doubled: int = 0) -> TimeReport:
    """Compute the statistics of growing times (N,)."""
    steps = np.diff(time_s)
    period = float(np.median(steps))
    long = steps > MIN_GAP_STEP * period
    return TimeReport(
        rows=len(time_s),
        doubled=doubled,
        period_s=period,
        shortest_s=float(steps.min()),
        longest_s=float(steps.max()),
        jitter_s=float(np.std(steps[~long])),
        gaps=int(long.sum()),
        missing=int((np.rint(steps[long] / period) - 1).sum()),
    )


def resample(
    time_s: Array,
    parts: Mapping[str, Array],
    *,
    rate_hz: float | None,
    largest_gap_periods: float | None = None,
    place: Location,
) -> GridValues:
    """Interpolate values to a uniform grid, by cubic splines.

    Rows that repeat the row before in time and values are left out, and rows whose `position` in
    `parts` does not fit their time (`rows_in_time`).

    Parameters
    ----------
    time_s : (N,) times in s.
    parts : values (N, n) by name.
    rate_hz : rate of the grid in Hz; by default that of the rows, rounded within their scatter.
    largest_gap_periods : longest accepted step, in median steps; by default ten times the rows.
    place : name of the source in errors.

    Raises
    ------
    BadInputError : there are fewer than 4 rows, time runs backwards, two rows of one time have
        different values, a step is too long, or the grid has fewer than 2 samples.
    """
    time_s, parts, report = rows_to_interpolate(time_s, parts, place, largest_gap_periods)
    rate_hz = rate_hz or roundest_rate_hz(time_s)
    count = int((time_s[-1] - time_s[0]) * rate_hz + 1e-6) + 1
    place.require(
        count >= 2 and rate_hz * report.period_s <= MAX_OVERSAMPLING,
        "resample_hz",
        rate_hz,
        text=f"the rows come at {1 / report.period_s:.4g} Hz and last "
        f"{time_s[-1] - time_s[0]:.4g} s",
        advice="Choose a rate near that of the rows",
    )
    grid = np.minimum(time_s[0] + np.arange(count) / rate_hz, time_s[-1])
    return GridValues(
        parts={name: interpolate(time_s, x, grid) for name, x in parts.items()},
        start_s=float(time_s[0]),
        rate_hz=rate_hz,
        report=replace(report, grid_hz=rate_hz),
        absent=in_gaps(time_s, grid),
    )


def interpolate(time_s: Array, x: Array, at_s: Array) -> Array:
    """Interpolate x (N, n) at the growing times (N,) to the growing times at_s (M,).

    The curves are cubic splines. This runs block by block: the rows of hours do not fit in memory
    with the coefficients of their splines.
    """
    from scipy.interpolate import CubicSpline

    values = allocate((len(at_s), x.shape[1]), many=8)
    for k, part in enumerate(
        np.split(np.arange(len(at_s)), np.searchsorted(at_s, time_s[BLOCK_ROWS::BLOCK_ROWS]))
    ):
        rows = slice(max(0, k * BLOCK_ROWS - _SPLINE_REACH), (k + 1) * BLOCK_ROWS + _SPLINE_REACH)
        values[part] = CubicSpline(time_s[rows], x[rows])(at_s[part])
    return values


def rows_to_interpolate(
    time_s: Array,
    parts: Mapping[str, Array],
    place: Location,
    largest_gap_periods: float | None = None,
) -> tuple[Array, Mapping[str, Array], TimeReport]:
    """Return the times and rows that `resample` uses, and a report on the times."""
    time_s, parts, doubled = _drop_repeated_rows(time_s, parts, place)
    place.require(
        len(time_s) >= 4,
        "time",
        text=f"only {len(time_s)} rows have different times",
        expected="at least 4",
    )
    report = time_report(time_s, doubled)
    if POSITION in parts:
        rows = np.flatnonzero(rows_in_time(time_s, parts[POSITION]))
        time_s, parts = time_s[rows], {name: taken(x, rows) for name, x in parts.items()}
    steps = np.diff(time_s)
    k, most = int(np.argmax(steps)), largest_gap_periods or MOST_MISSING * len(steps)
    place.require(
        steps[k] <= (most + 0.5) * report.period_s,
        "time",
        text=f"a gap of {steps[k]:.6g} s after {time_s[k] - time_s[0]:.6g} s is "
        f"{steps[k] / report.period_s:.1f} periods long, more than {most:g}",
        advice="Import the parts before and after it separately, or set time.largest_gap_periods",
    )
    return time_s, parts, replace(report, off=report.rows - len(time_s))


def _drop_repeated_rows(
    time_s: Array, parts: Mapping[str, Array], place: Location
) -> tuple[Array, Mapping[str, Array], int]:
    """Remove repeated rows from growing times and their values; also return their number."""
    steps = np.diff(time_s)
    if (row := first_true(steps < 0)) is not None:
        place.refuse(
            f"row {row + 2}",
            text=f"time runs backwards: {time_s[row + 1]:.9g} s follows {time_s[row]:.9g} s",
            advice="Check for two publishers, a clock that was set, or a counter that wrapped",
        )
    same = np.flatnonzero(steps == 0)
    for name, x in parts.items():
        for row in same[(x[same + 1] != x[same]).any(axis=1)]:
            place.refuse(
                f"row {row + 2}",
                text=f"{name} differs from the row before at the same time, {time_s[row]:.9g} s",
                advice="Give each row a time of its own; if timestamps are too coarse, name a "
                "counter in time.ticks",
            )
    keep = np.flatnonzero(np.concatenate([[True], steps > 0]))
    return time_s[keep], {name: taken(x, keep) for name, x in parts.items()}, len(same)


def roundest_rate_hz(time_s: Array, rows: Array | None = None) -> float:
    """Estimate the rate in Hz of growing times (N,), rounded within their scatter.

    `rows` (N,) numbers the times, which are consecutive without it. A rate is 1000, for example,
    not 1000.0013.
    """
    rows = row_numbers(time_s) if rows is None else rows
    period, start = np.polyfit(rows, time_s - time_s[0], 1)
    off = time_s - time_s[0] - start - period * rows
    return roundest(1 / period, 3 * float(np.std(off)) / float(time_s[-1] - time_s[0]), 1e-2)


def roundest(rate_hz: float, scatter: float, most: float = np.inf) -> float:
    """Return the rate rounded to the fewest digits within the relative `scatter`.

    The scatter is limited to `most` and to rounding.
    """
    within = min(max(scatter, 1e-12), most)
    return next(
        r for d in range(1, 18) if abs((r := float(f"{rate_hz:.{d}g}")) / rate_hz - 1) <= within
    )


def rate_warnings(report: TimeReport) -> list[str]:
    """Return warnings about the rate of a grid, and about rows left out.

    They are about a grid that is coarser or much finer than the rows, and about many rows left out.
    """
    if report.grid_hz is None:
        return []
    ratio, own_hz = report.grid_hz * report.period_s, 1 / report.period_s
    return holding(
        {
            f"{100 * report.off / report.rows:.2g} % of the rows are left out, because their "
            f"{report.clock} do not fit the motion: use another clock": (
                report.off > MAX_LEFT_OUT * report.rows
            ),
            f"resample_hz = {report.grid_hz:g} is below the rate of the rows, {own_hz:.4g} Hz, so "
            f"noise above {report.grid_hz / 2:g} Hz is aliased into the samples: use the rate of "
            "the rows (a fit decimates by itself)": ratio < MIN_RATE_RATIO,
            f"resample_hz = {report.grid_hz:g} is {ratio:.2g} times the rate of the rows, "
            f"{own_hz:.4g} Hz: the interpolated samples add no information": (
                ratio > MAX_RATE_RATIO
            ),
        }
    )


def uniform_grid(time_s: Array, parts: Mapping[str, Array], place: Location) -> GridValues:
    """Return values (N, n) at times (N,) that lie on a uniform grid.

    The function refuses times that do not grow or that leave the grid.
    """
    advice = "Set time.resample_hz to interpolate the rows to a uniform grid"
    steps = np.diff(time_s)
    if (row := first_true(steps <= 0)) is not None:
        place.refuse(
            f"row {row + 2}",
            text=f"its time, {time_s[row + 1]:.9g} s, is not later than the one before, "
            f"{time_s[row]:.9g} s",
            advice="Set time.resample_hz, which also removes duplicate rows",
        )
    period = float(np.median(steps))
    if (row := first_true(np.abs(steps - period) > 0.1 * period)) is not None:
        missing = round(steps[row] / period) - 1
        cause = f"{missing} rows missing" if missing > 0 else "not uniform"
        place.refuse(
            f"row {row + 2}",
            text=f"it comes {steps[row]:.6g} s after the row before, not {period:.6g} s ({cause})",
            advice=advice,
        )
    duration_s = float(time_s[-1] - time_s[0])
    period = duration_s / len(steps)
    off = np.abs(time_s - time_s[0] - period * np.arange(len(time_s)))
    place.require(
        off.max() <= 0.5 * period,
        f"row {int(np.argmax(off)) + 1}",
        text=f"it is {off.max():.6g} s away from a uniform grid, more than {0.5 * period:.6g} s",
        advice=advice,
    )
    return GridValues(
        parts=parts,
        start_s=float(time_s[0]),
        # The rate is rounded within the scatter of the times: 1000, not 1000.00000013.
        rate_hz=roundest(1 / period, float(off.max()) / duration_s, 1e-4),
        report=time_report(time_s),
    )


@dataclass(frozen=True, kw_only=True)
class ImportSummary:
    """A written recording, and what it does not contain about its import.

    Attributes:
        out: the recording.
        effort_units: units of the joint efforts.
        times: report on the times.
        topic: topic that was chosen by default.
        warnings: warnings, one line each.
    """

    out: Path
    effort_units: tuple[str, ...] = ()
    times: str = ""
    topic: str = ""
    warnings: tuple[str, ...] = ()


def write_samples(
    header: Header, grid: GridValues, warnings: Sequence[str], place: str, out: Path
) -> ImportSummary:
    """Check a grid and write it as the recording `out`, whole or not at all.

    Parameters
    ----------
    header : header of the recording.
    grid : the samples; parts have the names of a sample's fields.
    warnings : further warnings.
    place : name of the files in errors.
    out : the recording to write.

    Raises
    ------
    BadInputError : timestamps, positions or speeds are impossible.
    """
    robot, parts, stamps = header.robot, grid.parts, grid.stamps_ns(place)
    overshoots = (
        *check_recorded_positions(
            robot, (stamps - stamps[0]) * np.float64(1e-9), parts["position"], place
        ),
        *check_recorded_efforts(robot, parts["effort"]),
    )
    zero = [
        joint.name
        for joint, column in zip(robot.joints, parts["effort"].T, strict=True)
        if not column.any()
    ]
    warnings = [
        *warnings,
        *grid.warnings,
        *(
            [f"the effort of {', '.join(zero)} is zero in all rows, which biases a fit"]
            if zero
            else []
        ),
    ]
    if "velocity" in parts:
        warnings += check_recorded_velocities(
            robot, parts["position"], parts["velocity"], grid.rate_hz, place
        )
    rows = np.arange(len(stamps)) if grid.absent is None else np.flatnonzero(~grid.absent)
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        writer.columns(stamps[rows], {name: taken(x, rows) for name, x in parts.items()})
        for text in warnings:
            writer.event(int(stamps[-1]), "warning", text)
    return ImportSummary(
        out=out,
        effort_units=robot.effort_units,
        times=grid.notes.get("times", ""),
        warnings=(*overshoots, *warnings),
    )
