"""Import of tables (CSV, MAT) into a recording, by a `map.toml`; export of recordings as CSV.

The recording contains the columns and the rule of the efforts, and a report on the times of the
rows.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from ..arrays import Array, first_true
from ..errors import Location
from ..files import read_bytes, read_columns, taken, write_columns
from ..recording import OPTIONAL, Header, gaps, in_parts, read_recording
from ..robot import FILL_IN, EffortTiming, Payload, Positive, Robot, note, parse_toml
from .held import grid_of_new_rows
from .quantities import TIME_UNITS, TURN, Angles, Quantity, Source, TableNumber
from .stamps import even_times, ticks_from_velocity
from .time_base import (
    GridValues,
    ImportSummary,
    resample,
    uniform_grid,
    with_warnings,
    write_samples,
)

# A larger relative difference from the tick of the timestamps is a mistake.
MAX_TICK_ERROR = 0.01

FROM_VELOCITY = "from velocity"  # value of the key `ticks` instead of a column


class Time(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`[time]`: the column of times or of a counter, and the uniform grid."""

    column: Annotated[str | int | None, note("column of the times, by name or number")] = None
    unit: Annotated[str, note("unit of the times: s, ms, us or ns")] = "s"
    table: Annotated[
        TableNumber, note("file of the column, counted from 1 on the command line")
    ] = 1
    ticks: Annotated[
        str | int | None, note('column of a counter that gives the time, or "from velocity"')
    ] = None
    tick_s: Annotated[Positive | None, note("duration of a tick, s; required with ticks")] = None
    resample_hz: Annotated[
        Positive | None, note("rate to which all values are interpolated, Hz")
    ] = None
    largest_gap_periods: Annotated[
        Annotated[float, msgspec.Meta(ge=1.5)] | None,
        note("longest accepted step, in periods (default: any)"),
    ] = None


class TableMap(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Structure of `map.toml`: columns of a table, and the rate or the times of the samples.

    The columns are those of positions, efforts and other quantities.
    """

    position: Annotated[Angles, note("columns of the positions")]
    effort: Annotated[Quantity, note("columns of currents, voltages, torques or forces")]
    reference: Annotated[Angles | None, note("columns of the position reference")] = None
    velocity: Annotated[Quantity | None, note("columns of measured speeds")] = None
    known_torque: Annotated[Quantity | None, note("columns of external torques on the joints")] = (
        None
    )
    feedforward: Annotated[
        Quantity | None, note("columns of the feed-forward added to the controller's output")
    ] = None
    time: Annotated[
        Time | None, note("column of times or of a counter; replaces sample_rate_hz")
    ] = None
    sample_rate_hz: Annotated[Positive | None, note("sample rate, Hz; replaces [time]")] = None
    effort_timing: Annotated[
        EffortTiming,
        note(
            "what an effort is: the command that holds until the next row, the mean around "
            "the row, or the value at it"
        ),
    ] = "unknown"


def import_tables(
    tables: Sequence[Path], robot: Robot, map_path: Path, out: Path, payload: Payload | None = None
) -> ImportSummary:
    """Write a recording from CSV or MAT tables.

    Parameters
    ----------
    tables : the files.
    robot : the robot.
    map_path : map.toml with columns, units, sides (motor or joint) and times.
    out : the recording to write.
    payload : what the robot carried.

    Raises
    ------
    BadInputError : a table or the map cannot be read, or they do not fit. Nothing is written then.
    """
    place = Location(str(map_path))
    content = read_bytes(map_path)
    if lines := lines_to_fill_in(content):
        place.refuse(
            "lines",
            lines,
            text=f"they still contain {FILL_IN}",
            advice="Complete these lines and run the same command again",
        )
    table_map = parse_toml(content, TableMap, str(map_path))
    source = Source(tables=tables, robot=robot, place=place)
    parts, provenance, effort_object = _parts(source, table_map)
    rows = len(parts["position"])
    for key, part in parts.items():
        place.require(
            len(part) == rows, key, text=f"it has {len(part)} rows, but position has {rows}"
        )
    place.require(rows >= 2, "position", text=f"it has {rows} row, but a recording needs 2")
    names = ", ".join(table.name for table in tables)
    grid = _on_grid(source, table_map, parts)
    return write_samples(
        Header(
            robot=robot,
            source=f"tables {names}",
            sample_rate_hz=grid.rate_hz,
            effort_provenance=provenance,
            effort_timing=table_map.effort_timing,
            payload=payload,
            notes={**grid.notes, "effort_object": effort_object},
        ),
        grid,
        (),
        names,
        out,
    )


def lines_to_fill_in(content: bytes) -> list[int]:
    """Return the numbers of the lines of a map with `FILL_IN`.

    The first line, which explains it, does not count.
    """
    return [k for k, line in enumerate(content.splitlines()[1:], 2) if FILL_IN.encode() in line]


def _parts(source: Source, table_map: TableMap) -> tuple[dict[str, Array], str, str]:
    """Read all quantities of the map, at the joint (feed-forward: at the motor).

    Also return the origin of the efforts as a text, and their unit and side as another.
    """
    parts = {"position": source.position("position", table_map.position)}
    parts["effort"], provenance, effort_object = source.effort("effort", table_map.effort)
    if table_map.reference is not None:
        parts["reference"] = source.position("reference", table_map.reference)
        if table_map.position.unwrap or table_map.reference.unwrap:
            # Move the reference to the same turn as the positions.
            off = np.median(parts["reference"], axis=0) - np.median(parts["position"], axis=0)
            parts["reference"] -= TURN * np.rint(off / TURN)
    for name in OPTIONAL:
        if (quantity := getattr(table_map, name)) is not None:
            parts[name] = (source.velocity if name == "velocity" else source.effort_of_one_side)(
                name, quantity
            )
    return parts, provenance, effort_object


def _on_grid(source: Source, table_map: TableMap, parts: Mapping[str, Array]) -> GridValues:
    """Place the rows on a uniform grid, by the given rate or by their times."""
    time, given_hz = table_map.time, table_map.sample_rate_hz
    if time is None:
        rate_hz = source.place.given(
            given_hz, "sample_rate_hz", None, advice="Set it, or add a [time] table"
        )
        source.place.require(
            rate_hz >= 1,
            "sample_rate_hz",
            rate_hz,
            text="it looks like a period, not a rate",
            advice=f"Set the rate in Hz: {1 / rate_hz:g}",
        )
        time_s = np.arange(len(parts["position"])) / rate_hz
        return grid_of_new_rows(time_s, parts, source.place) or GridValues(
            parts=parts, start_s=0.0, rate_hz=rate_hz
        )
    time_s, scatter_s = _times(source, time, parts)
    # With counted ticks, rows of one tick are one row, even if their timestamps differ.
    is_new = np.concatenate([[True], np.diff(time_s) > 0]) | (time.ticks != FROM_VELOCITY)
    rows = np.flatnonzero(is_new)
    time_s, parts = taken(time_s, rows), {name: taken(x, rows) for name, x in parts.items()}
    place = Location(
        f"{source.table('time.table', time.table)}: "
        f"{time.column if time.ticks is None else time.ticks}"
    )
    if held := grid_of_new_rows(time_s, parts, place, time.resample_hz, time.largest_gap_periods):
        return held
    grid = (
        uniform_grid(time_s, parts, place)
        if time.resample_hz is None
        else resample(
            time_s,
            parts,
            rate_hz=time.resample_hz,
            largest_gap_periods=time.largest_gap_periods,
            place=place,
        )
    )
    source.place.require(
        given_hz is None or abs(given_hz / grid.rate_hz - 1) <= 1e-3,
        "sample_rate_hz",
        given_hz,
        text=f"the times have a rate of {grid.rate_hz:.9g} Hz"
        if time.resample_hz is None
        else "it cannot be combined with time.resample_hz",
        advice="Remove sample_rate_hz",
    )
    grid = with_warnings(
        grid,
        time_s,
        parts["position"],
        "ticks" if time.ticks is not None else "timestamps" if scatter_s is None else "even times",
        "use a counter of the robot as time.ticks, or sample_rate_hz instead of [time]",
    )
    assert grid.report is not None
    return replace(
        grid,
        report=replace(
            grid.report,
            doubled=grid.report.doubled + len(is_new) - len(rows),
            stamps_off_s=scatter_s,
        ),
    )


def _times(source: Source, time: Time, parts: Mapping[str, Array]) -> tuple[Array, float | None]:
    """Return the times (N,) of the rows by timestamps or ticks, and their scatter.

    The scatter is that of the timestamps about the ticks in s. It is None without both.
    """
    place = source.place
    place.require(
        (time.ticks is None) == (time.tick_s is None),
        "time.tick_s" if time.tick_s is None else "time.ticks",
        None,
        advice="Set ticks and tick_s together, or neither",
    )
    place.require(
        time.column is not None or time.ticks is not None,
        "time.column",
        None,
        advice="Set it, or ticks and tick_s",
    )
    place.require(
        time.unit in TIME_UNITS, "time.unit", time.unit, f"one of {', '.join(TIME_UNITS)}"
    )
    stamp_s = (
        None
        if time.column is None
        else _column(source, time, time.column, parts) * TIME_UNITS[time.unit]
    )
    if time.ticks is None or time.tick_s is None:
        assert stamp_s is not None
        return (
            even_times(stamp_s, parts["position"], time.resample_hz, place)
            if time.resample_hz
            else (stamp_s, None)
        )
    time_s = _ticks(source, time, time.ticks, time.tick_s, parts, stamp_s) * time.tick_s
    return time_s, None if stamp_s is None else stamp_scatter_s(time_s, stamp_s, time.tick_s, place)


def _ticks(
    source: Source,
    time: Time,
    name: str | int,
    tick_s: float,
    parts: Mapping[str, Array],
    stamp_s: Array | None,
) -> Array:
    """Return the ticks (N,) of the rows, of a counter or counted from positions and speeds."""
    if name == FROM_VELOCITY:
        if stamp_s is None or "velocity" not in parts:
            source.place.refuse(
                "time.ticks",
                name,
                text="ticks cannot be counted without timestamps and speeds",
                advice="Set time.column, and add [velocity]",
            )
        return ticks_from_velocity(stamp_s, parts["position"], parts["velocity"], tick_s)
    ticks = _column(source, time, name, parts)
    if (row := first_true(ticks != np.rint(ticks))) is not None:
        Location(f"{source.table('time.table', time.table)}: row {row + 1}").refuse(
            str(name), float(ticks[row]), "a whole number"
        )
    return ticks


def _column(source: Source, time: Time, name: str | int, parts: Mapping[str, Array]) -> Array:
    rows = len(parts["position"])
    column = read_columns(source.table("time.table", time.table), [name], 1)
    source.place.require(
        column.shape == (rows, 1),
        "time",
        expected=f"one column of {rows} rows",
        text=f"the selected numbers have the shape {column.shape}",
    )
    return np.asarray(column[:, 0])


def stamp_scatter_s(time_s: Array, stamp_s: Array, tick_s: float, place: Location) -> float:
    """Compute the standard deviation of timestamps about the times of ticks in s.

    The function refuses a wrong tick.
    """
    rate, start = np.polyfit(time_s - time_s[0], stamp_s, 1)
    place.require(
        abs(rate - 1) <= MAX_TICK_ERROR,
        "time.tick_s",
        tick_s,
        text=f"the timestamps show a tick of {tick_s * rate:.6g} s",
        advice="Correct tick_s, or the unit of the timestamps",
    )
    return float(np.std(stamp_s - start - rate * (time_s - time_s[0])))


def export_csv(path: Path, out: Path, warn: Callable[[str], None] = lambda text: None) -> int:
    """Write the joint samples of a recording as CSV in SI.

    Names of columns have units. The file is written whole or not at all.

    Parameters
    ----------
    path : the recording.
    out : the CSV file to write.
    warn : function that receives a warning if samples are missing.

    Returns
    -------
    The number of samples.
    """
    recording = read_recording(path)
    robot = recording.robot
    samples = Location(str(path)).given(
        recording.samples,
        text=recording.no_samples,
        advice="Decode its frames again: `robot-acquire import LOG.mcap --robot CORRECTED.toml`",
    )
    missing = [gap.missing for gap in gaps(samples, recording.sample_rate_hz) if not gap.late]
    if missing:
        warn(f"{sum(missing)} samples are missing in {len(missing)} gaps, and have no rows")
    fields = [field for field in samples.dtype.names or () if field != "stamp_ns"]
    names = [
        "time_s",
        *(
            f"{joint.name}_{field}_{_unit(robot, field, i)}"
            for field in fields
            for i, joint in enumerate(robot.joints)
        ),
    ]
    write_columns(
        out,
        ["_".join(name.split()) for name in names],
        (
            np.column_stack(
                [
                    (part["stamp_ns"] - samples["stamp_ns"][0]) * 1e-9,
                    *(part[field] for field in fields),
                ]
            )
            for part in in_parts(samples)
        ),
    )
    return len(samples)


def _unit(robot: Robot, field: str, joint: int) -> str:
    """Return the unit of a field of a joint's samples, for the name of a column."""
    unit, effort = robot.joints[joint].position_unit, robot.effort_units[joint]
    return {
        "velocity": f"{unit}_s",
        "effort": effort,
        "known_torque": effort,
        "feedforward": robot.motors[joint].recorded_unit,
    }.get(field, unit)
