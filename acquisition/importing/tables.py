"""Imports tables recorded elsewhere (CSV, MAT) into a recording; `map.toml` assigns the columns.

The rule from a table to joint samples is `Robot.joint_position` and `Robot.joint_effort`; the recording notes which
columns it was applied to.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from ..arrays import Array, Ints
from ..errors import AcquisitionError
from ..files import atomic_write, read_columns
from ..recording import LARGEST_STAMP_NS, Block, Header, RecordingWriter, sample_dtype
from ..robot import Positive, Robot, check_recorded_positions, parse_toml

Side = Literal["motor", "joint"]
TablePlace = Annotated[int, msgspec.Meta(ge=1)]

POSITION_UNITS = {
    "rad": ("rad", 1.0),
    "deg": ("rad", np.pi / 180),
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
}
EFFORT_UNITS = {
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    "N m": ("N m", 1.0),
    "mN m": ("N m", 1e-3),
    "N": ("N", 1.0),
}
TIME_UNITS = {"s": ("s", 1.0), "ms": ("s", 1e-3), "us": ("s", 1e-6), "ns": ("s", 1e-9)}


class Quantity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`[position]`, `[reference]` or `[effort]`: the columns, one per motor or joint, and what they are.

    Attributes:
        table: place of the file on the command line, from 1.
        columns: names, or numbers from 1.
        unit: one for all columns, or one for each.
        side: `motor` or `joint`; may be left out where it makes no difference or the unit decides.
    """

    columns: Annotated[tuple[str | int, ...], msgspec.Meta(min_length=1)]
    unit: str | tuple[str, ...]
    table: TablePlace = 1
    side: Side | None = None


class Time(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`[time]`: the column of sample times."""

    column: str | int
    unit: str = "s"
    table: TablePlace = 1


class TableMap(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`map.toml`: where position, effort and an optional reference are found, and the rate or the times of the samples."""

    position: Quantity
    effort: Quantity
    reference: Quantity | None = None
    time: Time | None = None
    sample_rate_hz: Positive | None = None


@dataclass(frozen=True, kw_only=True)
class Imported:
    """What an import wrote."""

    out: Path
    robot: str
    samples: int
    sample_rate_hz: float
    effort_units: tuple[str, ...]
    has_reference: bool
    warnings: tuple[str, ...] = ()


def import_tables(tables: Sequence[Path], robot: Robot, map_path: Path, out: Path) -> Imported:
    """Write the recording `out` from tables.

    Parameters
    ----------
    tables : CSV or MAT files.
    map_path : `map.toml`, which assigns columns, units and sides (motor or joint).

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
    q = _position("position", table_map.position, tables, robot, place)
    effort, provenance = _effort(table_map.effort, tables, robot, place)
    parts = {"position": q, "effort": effort}
    if table_map.reference is not None:
        parts["reference"] = _position("reference", table_map.reference, tables, robot, place)
    for key, part in parts.items():
        if len(part) != len(q):
            raise AcquisitionError(f"{len(part)} rows", place=place, key=key, expected=f"{len(q)} as in position")
    stamps, rate_hz = _stamps(table_map, tables, len(q), place)
    samples = np.empty(len(q), sample_dtype(robot.n, reference="reference" in parts))
    samples["stamp_ns"] = stamps
    warnings = check_recorded_positions(
        robot, (stamps - stamps[0]) * np.float64(1e-9), q, ", ".join(table.name for table in tables)
    )
    for key, part in parts.items():
        samples[key] = part
    _write(samples, robot, tables, rate_hz, provenance, out)
    return Imported(
        out=out,
        robot=robot.name,
        samples=len(samples),
        sample_rate_hz=rate_hz,
        effort_units=robot.effort_units,
        has_reference="reference" in parts,
        warnings=warnings,
    )


def _write(samples: Block, robot: Robot, tables: Sequence[Path], rate_hz: float, provenance: str, out: Path) -> None:
    source = "tables " + ", ".join(table.name for table in tables)
    with (
        atomic_write(out) as partial,
        RecordingWriter(
            partial, Header(robot=robot, source=source, sample_rate_hz=rate_hz, effort_provenance=provenance)
        ) as writer,
    ):
        writer.samples(samples)


def _values(key: str, quantity: Quantity, tables: Sequence[Path], robot: Robot, place: str) -> Array:
    values = read_columns(_table(f"{key}.table", quantity.table, tables, place), quantity.columns, robot.n)
    if values.shape[1] != robot.n:
        found = f"{values.shape[1]} columns"
        raise AcquisitionError(found, place=place, key=f"{key}.columns", expected=f"{robot.n}, one per joint")
    return values


def _table(key: str, number: int, tables: Sequence[Path], place: str) -> Path:
    if number > len(tables):
        expected = f"{len(tables)} at most, the number of tables given"
        raise AcquisitionError(place=place, key=key, value=number, expected=expected)
    return tables[number - 1]


def _si(
    key: str, quantity: Quantity, n: int, known: dict[str, tuple[str, float]], place: str
) -> list[tuple[str, float]]:
    """SI unit and factor of each column."""
    units = (quantity.unit,) * n if isinstance(quantity.unit, str) else quantity.unit
    if len(units) != n:
        raise AcquisitionError(
            f"{len(units)} units", place=place, key=f"{key}.unit", expected=f"one, or {n}, one per joint"
        )
    for unit in units:
        if unit not in known:
            raise AcquisitionError(place=place, key=f"{key}.unit", value=unit, expected=f"one of {', '.join(known)}")
    return [known[unit] for unit in units]


def _position(key: str, quantity: Quantity, tables: Sequence[Path], robot: Robot, place: str) -> Array:
    """Joint positions (N, n) in rad or m."""
    units = _si(key, quantity, robot.n, POSITION_UNITS, place)
    side = quantity.side
    if side is None:
        if not (np.array_equal(robot.R, np.eye(robot.n)) and not robot.zero.any()):
            raise AcquisitionError(place=place, key=f"{key}.side", value=None, expected="'motor' or 'joint'")
        side = "joint"
    if side == "joint" and robot.zero.any():
        joint = robot.joints[int(np.flatnonzero(robot.zero)[0])]
        name = "zero_deg" if joint.type == "revolute" else "zero_m"
        problem = f"{name} of joint {joint.name} in robot.toml would do nothing, joint positions are taken as they are"
        raise AcquisitionError(problem, place=place, key=f"{key}.side", value=side, expected=f"'motor', or no {name}")
    for i, (joint, (unit, _)) in enumerate(zip(robot.joints, units, strict=True)):
        # A motor turns whatever its joint does; a motor that slides drives a joint that slides.
        if unit != joint.position_unit and not (side == "motor" and unit == "rad"):
            expected = "an angle" if joint.type == "revolute" else "a length"
            problem = f"in {unit} for joint {i + 1} ({joint.name})"
            raise AcquisitionError(problem, place=place, key=f"{key}.unit", expected=expected)
    values = _values(key, quantity, tables, robot, place) * np.array([factor for _, factor in units])
    return robot.joint_position(values) if side == "motor" else values


def _effort(quantity: Quantity, tables: Sequence[Path], robot: Robot, place: str) -> tuple[Array, str]:
    """Joint efforts (N, n) in the robot's units, and where they come from."""
    units = _si("effort", quantity, robot.n, EFFORT_UNITS, place)
    found = tuple(unit for unit, _ in units)
    expected = {"motor": tuple(m.recorded_unit for m in robot.motors), "joint": robot.effort_units}
    fits = [side for side in ("motor", "joint") if found == expected[side]]
    side = quantity.side
    if side is None:
        same = np.array_equal(robot.R * robot.gain[:, None], np.eye(robot.n))
        if len(fits) == 2 and not same:
            raise AcquisitionError(place=place, key="effort.side", value=None, expected="'motor' or 'joint'")
        side = "joint" if fits == ["joint"] else "motor"
    if side not in fits:
        problem = f"gives {_one(found)} at the {side}"
        raise AcquisitionError(
            problem, place=place, key="effort.unit", expected=f"{_one(expected[side])} as robot.toml says"
        )
    values = _values("effort", quantity, tables, robot, place) * np.array([factor for _, factor in units])
    table = tables[quantity.table - 1].name
    unit = quantity.unit if isinstance(quantity.unit, str) else ", ".join(quantity.unit)
    origin = f"{table}: {', '.join(str(c) for c in quantity.columns)}: {unit} at the {side}"
    if side == "joint":
        return values, f"{origin}; joint effort = value in {_one(robot.effort_units)}"
    has_gain = robot.gain_known and any(m.drive_gain for m in robot.motors)
    gain = f" · drive gain {robot.gain.tolist()}" if has_gain else ""
    rule = f"joint effort = motor_matrixᵀ{gain} · value, in {_one(robot.effort_units)}"
    return robot.joint_effort(values), f"{origin}; {rule}"


def _one(units: Sequence[str]) -> str:
    return units[0] if len(set(units)) == 1 else ", ".join(units)


def _stamps(table_map: TableMap, tables: Sequence[Path], rows: int, place: str) -> tuple[Ints, float]:
    """Stamps (N,) in ns on a uniform grid, and its rate in Hz."""
    rate_hz, start_s = table_map.sample_rate_hz, 0.0
    if rows < 2:
        raise AcquisitionError(f"{rows} row", place=place, key="position", expected="2 at least")
    if table_map.time is not None:
        time = table_map.time
        if time.unit not in TIME_UNITS:
            expected = f"one of {', '.join(TIME_UNITS)}"
            raise AcquisitionError(place=place, key="time.unit", value=time.unit, expected=expected)
        table = _table("time.table", time.table, tables, place)
        column = read_columns(table, [time.column], 1)
        if column.shape != (rows, 1):
            raise AcquisitionError(
                f"shape {column.shape}", place=place, key="time", expected=f"one column of {rows} rows"
            )
        time_s = column[:, 0] * TIME_UNITS[time.unit][1]
        fitted_hz = _fitted_rate_hz(time_s, f"{table}: {time.column}")
        if rate_hz is not None and abs(rate_hz / fitted_hz - 1) > 1e-3:
            expected = f"{fitted_hz:.9g} as {table} says"
            raise AcquisitionError(place=place, key="sample_rate_hz", value=rate_hz, expected=expected)
        rate_hz, start_s = fitted_hz, max(0.0, float(time_s[0]))
    if rate_hz is None:
        raise AcquisitionError(place=place, key="sample_rate_hz", value=None, expected="it, or a [time] table")
    if not start_s + rows / rate_hz < LARGEST_STAMP_NS * 1e-9 or rate_hz > 1e8:
        problem = f"{rows} rows at {rate_hz} Hz from {start_s} s"
        raise AcquisitionError(problem, place=place, expected="68 years and 100 MHz at most")
    return round(start_s * 1e9) + np.rint(np.arange(rows) * (1e9 / rate_hz)).astype(np.int64), rate_hz


def _fitted_rate_hz(time_s: Array, place: str) -> float:
    """Rate of the uniform grid through `time_s`; refuses times that do not grow or that leave the grid."""
    steps = np.diff(time_s)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0))
        found = f"{time_s[row + 1]:.9g} s after {time_s[row]:.9g} s"
        raise AcquisitionError(found, place=place, key=f"row {row + 2}", expected="a later time")
    period = float(np.median(steps))
    bad = np.abs(steps - period) > 0.1 * period
    if bad.any():
        row = int(np.argmax(bad))
        missing = round(steps[row] / period) - 1
        cause = f"{missing} rows missing" if missing > 0 else "not uniform"
        found, expected = f"{steps[row]:.6g} s after the row before", f"{period:.6g} s ({cause})"
        raise AcquisitionError(found, place=place, key=f"row {row + 2}", expected=expected)
    period = float(time_s[-1] - time_s[0]) / len(steps)
    off = np.abs(time_s - time_s[0] - period * np.arange(len(time_s)))
    if off.max() > 0.5 * period:
        row = int(np.argmax(off))
        found, expected = f"{off[row]:.6g} s off a uniform grid", f"{0.5 * period:.6g} s at most"
        raise AcquisitionError(found, place=place, key=f"row {row + 1}", expected=expected)
    # The roundest rate that the scatter of the times cannot tell from the measured one: 1000, not 1000.00000013.
    scatter = min(max(float(off.max()) / float(time_s[-1] - time_s[0]), 1e-12), 1e-4)
    return next(r for d in range(1, 18) if abs((r := float(f"{1 / period:.{d}g}")) * period - 1) <= scatter)
