"""Import of a capture of an EtherCAT bus in operation.

The frames are converted to joint samples at the times of cycles. Nothing is ever sent. In each
cycle the master's datagrams pass all slaves and come back. The slaves write their inputs to them,
read their outputs, and count in the working counter:

    captures        packets in the order of their times, and the datagrams in them; logical address
                    of each object that a slave maps, by its FMMUs and by CoE
    process_data    rows: the integers of all drives, of datagrams with full working counters
    this file       number of the cycle of each row, the time of each cycle

1. **Cycles**: rows are late by delays of the capture, which do not last. So a row is no later than
   the earliest of the next rows, counted in periods; a step of whole periods in that is cycles
   without a row. The number of a delayed row is certain if those of the rows before and after it
   agree.
2. **Times**: whole periods from a common start, the median over all rows.
3. **Reference**: what a master sends in a cycle is the target that the drives have in the next one,
   so a row needs the row of the cycle before.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..arrays import Array, Bools, Ints
from ..errors import Location, holding
from ..files import atomic_write, field_of, release_pages
from ..recording import (
    Block,
    Header,
    RecordingWriter,
    in_parts,
    joint_samples,
    minimum_ahead,
    refuse_period,
)
from ..robot import Bus, check_recorded_efforts, check_recorded_positions
from .captures import PCAP_HEAD, packets, parse_mapping
from .process_data import (
    AT_ONCE,
    MARGIN,
    MAX_BACK,
    MAX_OFF,
    ProcessData,
)
from .time_base import ImportSummary

# Clocks differ by less than this, so a measured period this near to that in robot.toml is equal to
# it.
_MAX_CLOCK_ERROR = 2e-4
_MIN_SHARE = 0.5  # of the rows; with fewer targets there is no reference
_LATE = 15  # a delay of more rows is a lasting one
MAPPING_NOTE = "ethercat_mapping"  # key of the metadata


def cycle_numbers(time_ns: Ints, period_ns: float) -> tuple[Ints, Bools]:
    """Number the cycles of rows at `time_ns` (m,), and return which numbers are certain.

    Delays do not last, and late rows are consecutive.
    """
    number, certain, reached = (
        np.empty(len(time_ns), np.int64),
        np.empty(len(time_ns), np.bool_),
        0.0,
    )
    for first in range(0, len(time_ns), AT_ONCE):
        begin, end = max(0, first - MARGIN), first + AT_ONCE
        some, sure, level = _numbers(
            time_ns[begin : end + MARGIN], period_ns, first - begin, reached
        )
        number[first:end] = some[first - begin : end - begin] + begin
        certain[first:end] = sure[first - begin : end - begin]
        reached = float(level[min(end - begin, len(level) - 1)])
    return number, certain


def _numbers(
    time_ns: Ints, period_ns: float, row: int, reached: float
) -> tuple[Ints, Bools, Array]:
    """Number cycles as `cycle_numbers` does; also return how many have no row.

    The count is that of the cycles without a row before each row. It is `reached` at `row`.
    """
    k = np.arange(len(time_ns))
    late = (time_ns - time_ns[0]) / period_ns - k
    on_time = minimum_ahead(late, _LATE)
    steps = np.diff(on_time)
    # Small steps are the drift of the clocks.
    steps[np.abs(steps) < MAX_OFF] = 0.0
    level, breaks = (
        np.concatenate([[0], np.cumsum(x)])
        for x in (steps, np.abs(steps - np.rint(steps)) > MAX_OFF)
    )
    missing = level + (reached - level[row])
    level = np.rint(missing).astype(np.int64)
    delayed = late - on_time > MAX_OFF
    before = np.maximum.accumulate(np.where(delayed, 0, k))
    after = np.minimum.accumulate(np.where(delayed, len(k) - 1, k)[::-1])[::-1]
    steps = np.diff(time_ns) / period_ns
    near = np.abs(steps - 1) < MAX_OFF
    near = np.concatenate([[False], near]) | np.concatenate([near, [False]])
    certain = (
        (level[before] == level[after])
        & (breaks[before] == breaks[after])
        & (near | delayed)
        & ~(delayed[before] | delayed[after])
    )
    # A row that follows an uncertain one too early may be an additional row.
    certain[1:] &= certain[:-1] | (steps > 1 - MAX_OFF)
    return k + level[before], certain, missing


def _period_ns(time_ns: Ints) -> float:
    """Estimate the time between two cycles, by the median of steps over more and more rows."""
    period = float(np.median(np.diff(time_ns)))
    for ahead in (32, 1024):
        if period > 0 and len(time_ns) > ahead:
            steps = time_ns[ahead:] - time_ns[:-ahead]
            period = float(np.median(steps / np.maximum(np.rint(steps / period), 1)))
    return period


def import_capture(
    file: BinaryIO, header: Header, bus: Bus, at: Location, out: Path
) -> ImportSummary:
    """Write the recording `out` from a capture (pcap, pcapng) of an EtherCAT bus in operation.

    There is one row for each cycle with full working counters: rad or m, and N m or N (A or V if a
    drive gain is unknown), at the joints, at the times of whole periods; `reference` is the target
    of the cycle before. Frames are kept in the recording.

    Parameters
    ----------
    file : the capture.
    header : header of the recording. Its note `MAPPING_NOTE` has the mapping if the capture begins
        after the bus was configured.
    bus : the drives.
    at : name of the file in errors.
    out : the recording to write.

    Raises
    ------
    BadInputError : the file is not a capture, no process data come back, or it has no mapping or
        another period.
    """
    robot, warnings = header.robot, list[str]()
    process = ProcessData(bus, parse_mapping(header.notes.get(MAPPING_NOTE, "").split()), at)
    head = PCAP_HEAD
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        for given in packets(file, at, warnings, MAX_BACK * bus.period_ns):
            kept = process.add(given)
            if len(kept):
                writer.captured(head + given.records(kept), int(given.time_ns[kept[0]]))
                head = b""
        rows, chosen, stamp_ns, times, has_reference = _on_grid(
            process, bus.period_ns, at, warnings
        )
        first_ns, last_ns = int(stamp_ns[0]), int(stamp_ns[-1])
        for block in joint_samples(_chosen(rows, chosen, stamp_ns, has_reference), robot, bus):
            writer.samples(block)
            t_s = (block["stamp_ns"] - first_ns) * np.float64(1e-9)
            warnings += (
                *check_recorded_positions(robot, t_s, block["position"], str(at)),
                *check_recorded_efforts(robot, block["effort"]),
            )
        for text in dict.fromkeys(warnings):
            writer.event(last_ns, "warning", text)
    return ImportSummary(
        out=out,
        effort_units=robot.effort_units,
        times=times,
        warnings=tuple(dict.fromkeys(warnings)),
    )


def _chosen(rows: Block, chosen: Ints, stamp_ns: Ints, has_reference: bool) -> Iterator[Block]:
    """Yield the chosen rows with their timestamps, some at a time.

    The targets of a row are those of the cycle before, because the drives had these targets then.
    """
    for first in range(0, len(chosen), AT_ONCE):
        some = chosen[first : first + AT_ONCE]
        found = rows[some]
        found["stamp_ns"], found["target"] = (
            stamp_ns[first : first + AT_ONCE],
            rows["target"][some - 1],
        )
        release_pages(rows)
        yield found if has_reference else found[["stamp_ns", "position", "effort"]]


def _on_grid(
    process: ProcessData, nominal_ns: int, at: Location, warnings: list[str]
) -> tuple[Block, Ints, Ints, str, bool]:
    """Place the rows on the grid of cycles.

    Returns the rows, the numbers and timestamps of those whose cycle is certain, the report on the
    times, and whether there is a reference.
    """
    rows, clock = process.rows()
    if len(rows) < 4:
        process.refuse_no_rows()
    time_ns = field_of(rows, "clock_ns" if clock else "stamp_ns")
    # Clocks of 32 bits wrap; the time of the capture gives the higher bits.
    if clock and time_ns.max() < 2**32:
        since = field_of(rows, "stamp_ns")
        time_ns = since + (time_ns - time_ns[0] - since + since[0] + 2**31) % 2**32 - 2**31
        del since
    period_ns = _period_ns(time_ns)
    refuse_period(period_ns * 1e-9, nominal_ns * 1e-9, str(at), np.diff(time_ns) * 1e-9, "a cycle")
    if abs(period_ns / nominal_ns - 1) < _MAX_CLOCK_ERROR:
        period_ns = float(nominal_ns)
    number, certain = cycle_numbers(time_ns, period_ns)
    start_ns = int(
        np.median(time_ns - np.rint(number * period_ns).astype(np.int64), overwrite_input=True)
    )
    # This array is large in a long capture, and not needed any more.
    del time_ns
    known = np.concatenate([some["known"].copy() for some in in_parts(rows)])
    has_reference = bool(known.mean() > _MIN_SHARE)
    certain[1:] &= (np.diff(number) == 1) & certain[:-1] & known[:-1] | (not has_reference)
    certain[0] &= not has_reference
    chosen = np.flatnonzero(certain)
    chosen = chosen[np.diff(number[chosen], prepend=-1) > 0]
    if len(chosen) < 2:
        process.refuse_no_rows()
    number = number[chosen]
    # The first row has no target, because there is no row before it.
    uncertain = len(rows) - len(chosen) - has_reference
    warnings += holding(
        {
            "no reference is imported: the targets are not mapped, or frames to the slaves were "
            "not captured": not has_reference,
            "the capture contains no answers of slaves: the mapping is what the master wrote": (
                process.unanswered
            ),
            f"{process.short} cycles with an incomplete working counter are left out": (
                process.short
            ),
            f"{uncertain} rows beside lost or late frames are left out, because their cycle or "
            "target is uncertain": uncertain,
        }
    )
    steps = np.diff(number)
    gaps = (
        f"{(steps > 1).sum()} gaps, {(steps - 1).sum()} rows missing"
        if (steps > 1).any()
        else "no gaps"
    )
    return (
        rows,
        chosen,
        max(0, start_ns) + np.rint(number * period_ns).astype(np.int64),
        f"{'distributed clocks' if clock else 'timestamps of the capture'}: "
        f"{1e-6 * period_ns:.9g} ms from cycle to cycle, {gaps}, "
        f"{process.doubled or 'no'} duplicate rows",
        has_reference,
    )
