"""Imports tables recorded elsewhere (CSV, MAT) into a recording; `map.toml` assigns the columns.

The recording notes which columns the efforts are of, by which rule, and what the times of the rows were like.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError
from ..files import read_columns
from ..recording import OPTIONAL
from ..robot import Robot, parse_toml
from .quantities import Source
from .samples import Imported, Samples, write_samples
from .stamps import stamps_warning, ticks_from_velocity
from .table_map import FROM_VELOCITY, TIME_UNITS, TableMap, Time
from .time_base import OnGrid, rate_doubts, report_of, resample, stamps_ns, uniform_rate_hz

TICK_OFF = 0.01  # a tick that differs by more than this share from that of the stamps is a mistake


def import_tables(tables: Sequence[Path], robot: Robot, map_path: Path, out: Path) -> Imported:
    """Write the recording `out` from tables.

    Parameters
    ----------
    tables : CSV or MAT files.
    map_path : `map.toml`, which assigns columns, units and sides (motor or joint), and says how times are read.

    Raises
    ------
    AcquisitionError
        With `place` (file), `key`, `value` and `expected`; nothing is written then.
    """
    place = str(map_path)
    try:
        table_map = parse_toml(map_path.read_bytes(), TableMap, place)
    except OSError as error:
        raise AcquisitionError(f"cannot be read: {error.strerror}", place=place) from error
    source = Source(tables=tables, robot=robot, place=place)
    parts, provenance = _parts(source, table_map)
    rows = len(parts["position"])
    for key, part in parts.items():
        if len(part) != rows:
            raise AcquisitionError(f"{len(part)} rows", place=place, key=key, expected=f"{rows} as in position")
    if rows < 2:
        raise AcquisitionError(f"{rows} row", place=place, key="position", expected="2 at least")
    if table_map.time is None:
        if table_map.sample_rate_hz is None:
            raise AcquisitionError(place=place, key="sample_rate_hz", value=None, expected="it, or a [time] table")
        timed = _Timed(parts=parts, start_s=0.0, rate_hz=table_map.sample_rate_hz)
    else:
        timed = _timed(source, table_map, table_map.time, parts)
    names = ", ".join(table.name for table in tables)
    samples = Samples(
        robot=robot,
        parts=timed.parts,
        stamps=stamps_ns(timed.start_s, len(timed.parts["position"]), timed.rate_hz, place),
        rate_hz=timed.rate_hz,
        place=names,
        source=f"tables {names}",
        provenance=provenance,
        report=timed.report,
        doubts=timed.doubts,
        effort_timing=table_map.effort_timing,
    )
    return write_samples(samples, out)


def _parts(source: Source, table_map: TableMap) -> tuple[dict[str, Array], str]:
    """All that the map assigns, at the joint (feed-forward: at the motor), and where the efforts come from."""
    parts = {"position": source.position("position", table_map.position)}
    parts["effort"], provenance = source.effort("effort", table_map.effort)
    if table_map.reference is not None:
        parts["reference"] = source.position("reference", table_map.reference)
    for name, read in zip(OPTIONAL, (source.velocity, source.known_torque, source.feedforward), strict=True):
        quantity = getattr(table_map, name)
        if quantity is not None:
            parts[name] = read(name, quantity)
    return parts, provenance


@dataclass(frozen=True, kw_only=True, eq=False)
class _Timed(OnGrid):
    """Values on a uniform grid, the report where times were read, and doubts about these."""

    doubts: tuple[str, ...] = ()


def _timed(source: Source, table_map: TableMap, time: Time, parts: Mapping[str, Array]) -> _Timed:
    place, rows = source.place, len(parts["position"])
    if (time.ticks is None) != (time.tick_s is None):
        key = "time.tick_s" if time.tick_s is None else "time.ticks"
        raise AcquisitionError(place=place, key=key, value=None, expected="ticks and tick_s together, or neither")
    if time.column is None and time.ticks is None:
        raise AcquisitionError(place=place, key="time.column", value=None, expected="it, or ticks and tick_s")
    table = source.table("time.table", time.table)
    stamp_s, clock = _stamps(table, time, rows, place), "stamps"
    time_s = stamp_s
    off_s, twice = None, 0
    label = str(time.column)
    if time.ticks is not None:
        assert time.tick_s is not None
        ticks = (
            _column(table, time.ticks, rows, place)
            if time.ticks != FROM_VELOCITY
            else _counted(time, stamp_s, parts, place)
        )
        if (ticks != np.rint(ticks)).any():
            row = int(np.argmax(ticks != np.rint(ticks)))
            raise AcquisitionError(
                place=f"{table}: row {row + 1}", key=str(time.ticks), value=float(ticks[row]), expected="whole counts"
            )
        time_s, clock, label = ticks * time.tick_s, "ticks", str(time.ticks)
        if stamp_s is not None:
            off_s = _off_ticks(time_s, stamp_s, time.tick_s, place)
        if time.ticks == FROM_VELOCITY:
            new = np.concatenate([[True], np.diff(time_s) > 0])
            time_s, parts, twice = time_s[new], {name: x[new] for name, x in parts.items()}, int((~new).sum())
    assert time_s is not None
    where = f"{table}: {label}"
    if time.resample_hz is None:
        rate_hz = uniform_rate_hz(time_s, where)
        timed = OnGrid(parts=parts, start_s=float(time_s[0]), rate_hz=rate_hz, report=report_of(time_s))
    else:
        timed = resample(
            time_s, parts, rate_hz=time.resample_hz, largest_gap_periods=time.largest_gap_periods, place=where
        )
    given = table_map.sample_rate_hz
    if given is not None and abs(given / timed.rate_hz - 1) > 1e-3:
        expected = (
            f"{timed.rate_hz:.9g} as {table} says" if time.resample_hz is None else "none beside time.resample_hz"
        )
        raise AcquisitionError(place=place, key="sample_rate_hz", value=given, expected=expected)
    growing = np.concatenate([[True], np.diff(time_s) > 0])
    way_out = "take a counter of the robot as time.ticks, or state sample_rate_hz in place of [time]"
    warning = stamps_warning(time_s[growing], parts["position"][growing], way_out)
    doubts = [*rate_doubts(timed.report), *([warning] if warning else [])]
    assert timed.report is not None
    return _Timed(
        parts=timed.parts,
        start_s=timed.start_s,
        rate_hz=timed.rate_hz,
        report=replace(timed.report, clock=clock, stamps_off_s=off_s, doubled=timed.report.doubled + twice),
        doubts=tuple(doubts),
    )


def _counted(time: Time, stamp_s: Array | None, parts: Mapping[str, Array], place: str) -> Array:
    """Ticks of rows that have stamps and speeds."""
    assert time.tick_s is not None
    if stamp_s is None or "velocity" not in parts:
        expected = "time.column, the stamps, and [velocity] beside it"
        raise AcquisitionError(place=place, key="time.ticks", value=time.ticks, expected=expected)
    return ticks_from_velocity(stamp_s, parts["position"], parts["velocity"], time.tick_s)


def _stamps(table: Path, time: Time, rows: int, place: str) -> Array | None:
    """Times of the rows (N,) in s by the column of times; None without one."""
    if time.unit not in TIME_UNITS:
        expected = f"one of {', '.join(TIME_UNITS)}"
        raise AcquisitionError(place=place, key="time.unit", value=time.unit, expected=expected)
    if time.column is None:
        return None
    return _column(table, time.column, rows, place) * TIME_UNITS[time.unit][1]


def _column(table: Path, name: str | int, rows: int, place: str) -> Array:
    column = read_columns(table, [name], 1)
    if column.shape != (rows, 1):
        raise AcquisitionError(f"shape {column.shape}", place=place, key="time", expected=f"one column of {rows} rows")
    return np.asarray(column[:, 0])


def _off_ticks(time_s: Array, stamp_s: Array, tick_s: float, place: str) -> float:
    """Deviation in s of stamps about the time that ticks give; refuses ticks of another length."""
    rate, start = np.polyfit(time_s - time_s[0], stamp_s, 1)
    if not abs(rate - 1) <= TICK_OFF:
        expected = f"{tick_s * rate:.6g} as the stamps say"
        raise AcquisitionError(place=place, key="time.tick_s", value=tick_s, expected=expected)
    return float(np.std(stamp_s - start - rate * (time_s - time_s[0])))
