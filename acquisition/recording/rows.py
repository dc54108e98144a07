"""Rows of recordings, raw CAN frames and joint samples, as numpy dtypes, and their checks.

The module also finds frames by PDO, and the PDO mapping that they contain. It makes samples from
the integers of drives.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Ints
from ..errors import Location, holding
from ..files import by_rows, kept, release_pages
from ..protocol import ANSWER, HEARTBEAT, REQUEST, SDO_OBJECTS, Confirmed, ObjectEntry, Pdo
from ..robot import Bus, Robot, resolve

CAPTURE_TOPIC = "/ethercat/frames"
# One raw CAN frame; `data` beyond `length` is zero.
FRAME = np.dtype(
    [("time_ns", "<i8"), ("can_id", "<u4"), ("length", "u1"), ("flags", "u1"), ("data", "u1", (8,))]
)
# Bits of FRAME's `flags`.
SENT = 1  # sent by this master; otherwise received
EXTENDED = 2  # 29-bit identifier
ERROR = 4
REMOTE_REQUEST = 8
CAN_FD = 16  # the recorder counts these frames, but does not record them
_AT_ONCE = 100_000  # rows in memory at once; all others may be on disk
# The rows of one PDO are spread over many more frames, so fewer are in memory at once.
_TAKEN = 20_000
# A step over missing rows may deviate from whole periods by so many periods.
MAX_PERIOD_OFFSET = 0.1
MAX_STAMP_NS = 2**31 * 1_000_000_000 - 1  # a ROS time counts seconds in 32 bits

Block = NDArray[np.void]
# Indices of frames or SYNCs take half the memory of Ints.
Rows = NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Gap:
    """A gap of `missing` samples between row `row` and the next.

    The gap is at `stamp_ns`, the timestamp of row `row`. `late` is True if only SYNC was late.
    """

    row: int
    stamp_ns: int
    missing: int
    late: bool = False


# Optional fields of rows, in their order: measured joint speeds in rad/s or m/s; external torques
# on the joints in N m or N; feed-forward added to the controller's output, by motor, in the unit of
# the recorded effort.
OPTIONAL = ("velocity", "known_torque", "feedforward")


def sample_dtype(n: int, *, reference: bool, optional: Collection[str] = ()) -> np.dtype[np.void]:
    """Return the dtype of a row of samples of `n` joints.

    The fields are `stamp_ns`, and `position`, `effort`, `reference` and fields of `OPTIONAL`, (n,)
    each.
    """
    names = [
        "position",
        "effort",
        *["reference"] * reference,
        *(name for name in OPTIONAL if name in optional),
    ]
    return np.dtype([("stamp_ns", "<i8"), *((name, "<f8", (n,)) for name in names)])


def gaps(samples: Block, sample_rate_hz: float, sync_ns: Ints | None = None) -> tuple[Gap, ...]:
    """Find gaps: consecutive timestamps more than 1.5 periods apart.

    Parameters
    ----------
    samples : rows of `sample_dtype`.
    sample_rate_hz : nominal sample rate in Hz.
    sync_ns : times of the SYNCs that this master sent. A gap is `late` if no other one lies in it;
        without `sync_ns`, if it is not a multiple of the period.
    """
    stamps = samples["stamp_ns"]
    periods = np.diff(stamps) * (sample_rate_hz * 1e-9)
    rows = np.flatnonzero(periods > 1.5)
    late = np.abs(periods[rows] - np.rint(periods[rows])) > MAX_PERIOD_OFFSET
    if sync_ns is not None:
        late = (
            np.searchsorted(sync_ns, stamps[rows + 1])
            - np.searchsorted(sync_ns, stamps[rows], "right")
            == 0
        )
    return tuple(
        Gap(
            row=int(k),
            stamp_ns=int(stamps[k]),
            missing=round(float(periods[k])) - 1,
            late=bool(one),
        )
        for k, one in zip(rows, late, strict=True)
    )


def in_parts(rows: Block) -> Iterator[Block]:
    """Yield parts of the rows that fit in memory."""
    for first in range(0, len(rows), _AT_ONCE):
        yield rows[first : first + _AT_ONCE]
        release_pages(rows)


def check_samples(samples: Block, after_ns: int, place: str) -> None:
    """Refuse timestamps that do not grow from `after_ns`, and values that are not finite.

    `place` is the name of the recording in errors.
    """
    for k, rows in enumerate(in_parts(samples)):
        stamps = rows["stamp_ns"]
        before = np.concatenate([[after_ns], stamps[:-1]])
        if len(bad := np.flatnonzero((stamps <= before) | (stamps > MAX_STAMP_NS))):
            Location(f"{place}: row {k * _AT_ONCE + bad[0] + 1}").refuse(
                "stamp_ns", int(stamps[bad[0]]), f"growing timestamps, 0 to {MAX_STAMP_NS}"
            )
        after_ns = int(stamps[-1])
        for field in (samples.dtype.names or ())[1:]:
            finite = np.isfinite(rows[field])
            if not finite.all():
                row, joint = np.argwhere(~finite)[0]
                Location(f"{place}: row {k * _AT_ONCE + row + 1}").refuse(
                    f"{field} of joint {joint + 1}",
                    float(rows[field][row, joint]),
                    "a finite number",
                )


def check_frames(frames: Block, place: str) -> None:
    """Refuse frames longer than 8 bytes and times before 0.

    `place` is the name of the recording in errors.
    """
    for k, rows in enumerate(in_parts(frames)):
        if len(bad := np.flatnonzero((rows["length"] > 8) | (rows["time_ns"] < 0))):
            Location(f"{place}: row {k * _AT_ONCE + bad[0] + 1}").refuse(
                text=f"a frame has length = {rows['length'][bad[0]]}, "
                f"time_ns = {rows['time_ns'][bad[0]]}",
                expected="at most 8 bytes, and a time of 0 or greater",
            )


class Traffic:
    """The `frames` of one channel and their 11-bit identifiers `ids` (len(frames),).

    Error frames, extended frames and remote requests have the identifier 0xFFFF.
    """

    def __init__(self, frames: Block) -> None:
        self.frames = frames
        self.ids: NDArray[np.uint16] = by_rows(
            lambda x: np.where(
                x["flags"] & (EXTENDED | ERROR | REMOTE_REQUEST), 0xFFFF, x["can_id"]
            ).astype(np.uint16),
            frames,
        )

    def of(self, pdo: Pdo) -> tuple[Rows, int]:
        """Return the rows of the frames that contain the whole PDO.

        Also return the number of those that are too short.
        """
        rows = self.rows_of(pdo.can_id)
        whole = self.at("length", rows) >= pdo.length
        return kept(rows[whole]), int(np.count_nonzero(~whole))

    def rows_of(self, can_id: int) -> Rows:
        """Return the rows of the frames with an identifier."""
        return kept(np.flatnonzero(self.ids == can_id).astype(np.int32))

    def at(self, field: str, rows: Rows) -> NDArray[Any]:
        """Return a field of the frames `rows`."""
        return self._take(self.frames[field], rows)

    def integers(self, rows: Rows, pdo: Pdo, entry: ObjectEntry) -> Ints:
        """Extract the integers of one object from the frames `rows`."""
        # A strided field over the rows in place is three times as fast as copying the bytes of each
        # frame, which are the last 8 of its row.
        only = np.dtype(
            {
                "names": ["value"],
                "formats": [f"<{entry.type[0].lower()}{entry.bits // 8}"],
                "offsets": [FRAME.itemsize - 8 + pdo.offset(entry.index, entry.sub)],
                "itemsize": FRAME.itemsize,
            }
        )
        return self._take(self.frames.view(only)["value"], rows).astype(np.int64)

    def _take(self, column: NDArray[Any], rows: Rows) -> NDArray[Any]:
        values = kept(np.empty((len(rows), *column.shape[1:]), column.dtype))
        for first in range(0, len(rows), _TAKEN):
            part = slice(first, first + _TAKEN)
            values[part] = column[rows[part]]
            release_pages(self.frames)
        return values


def resolve_mapped(frames: Block, robot: Robot, place: str) -> tuple[Block, Bus]:
    """Return the frames, and the drives with the PDO mapping in them.

    If a drive is mapped by traffic, these are the frames between two changes of the mapping that
    have most PDOs of the log. Others are left out with a warning. In a log without answers the
    mapping is what a master wrote, with a warning. Raise `BadInputError` as `resolve`.
    """
    traffic = Traffic(frames)
    pdos = (traffic.ids > 0x180) & (traffic.ids < ANSWER)
    silent = not ((traffic.ids > ANSWER) & (traffic.ids < REQUEST)).any()
    files = robot.bus.drive if robot.bus is not None else ()
    drives = {file.node: Confirmed(silent=silent) for file in files}
    parts, first, known = list[tuple[int, int, dict[int, Confirmed]]](), 0, deepcopy(drives)
    for row in _mapping_rows(traffic).tolist():
        if _changed(drives, int(traffic.ids[row]), bytes(frames[row]["data"])):
            parts.append((first, row, known))
            first = row
        # A request that is not answered changes nothing.
        if silent or traffic.ids[row] & 0xFF80 != REQUEST:
            known = {k: replace(drive, values=dict(drive.values)) for k, drive in drives.items()}
    parts.append((first, len(frames), drives))
    first, end, known = max(parts, key=lambda part: (pdos[part[0] : part[1]].sum(), part[0]))
    bus = resolve(robot, place, known)
    if not any(file.mapping == "traffic" for file in files):
        return frames, bus
    left_out = np.count_nonzero(pdos) - np.count_nonzero(pdos[first:end])
    told = holding(
        {
            "the log contains no answers of drives: the mapping is what the master wrote": silent,
            f"{left_out} of {np.count_nonzero(pdos)} PDOs are left out: when they were sent, a "
            "drive had another mapping, or one that was not logged": left_out,
        }
    )
    return frames[first:end], replace(bus, notes=(*bus.notes, *told))


def _changed(drives: Mapping[int, Confirmed], can_id: int, data: bytes) -> bool:
    """Process a frame; return whether it changed the mapping of one of the drives."""
    # NMT has the node in its data, 0 for all nodes.
    node = can_id & 0x7F or data[1]
    changes = [drive.take(can_id & 0x780, data) for k, drive in drives.items() if node in (0, k)]
    return any(changes)


def _mapping_rows(traffic: Traffic) -> Rows:
    """Find frames about the mapping: SDO about `SDO_OBJECTS`, and starts and resets of drives."""
    rows = np.flatnonzero(
        np.isin(traffic.ids & 0xFF80, (ANSWER, REQUEST, HEARTBEAT)) | (traffic.ids == 0)
    ).astype(np.int32)
    ids, data = traffic.ids[rows], traffic.at("data", rows)
    index = np.ascontiguousarray(data[:, 1:3]).view("<u2")[:, 0]
    sdo = np.isin(index, SDO_OBJECTS) & (traffic.at("length", rows) == 8)
    # NMT resets a node or its communication; a boot-up message shows that it has started.
    kinds = [ids == 0, ids & 0x7F == 0, ids > HEARTBEAT]
    starts = [np.isin(data[:, 0], (0x81, 0x82)), np.False_, data[:, 0] == 0]
    return kept(rows[np.select(kinds, starts, sdo)])


def wraps_of(counts: Ints, bits: int) -> Ints:
    """Return the rows at which a counter of `bits` wraps, as `np.unwrap` finds them.

    A step of more than half its range is a wrap.
    """
    return np.flatnonzero(np.abs(np.diff(counts)) > 1 << (bits - 1)) + 1


def joint_samples(raw: Iterable[Block], robot: Robot, bus: Bus) -> Iterator[Block]:
    """Compute rows of `sample_dtype` from the integers of drives.

    Position counters that wrap continue. Targets wrap as the position does, and the nearest one is
    used.

    Parameters
    ----------
    raw : consecutive rows of `stamp_ns`, and `position`, `effort` and perhaps `target` (n,).
    robot : the robot.
    bus : its drives.
    """
    # This is the raw position of each drive in the row before, and the counts added to it.
    last: list[tuple[int, int]] = []
    for rows in raw:
        target = rows["target"] if "target" in (rows.dtype.names or ()) else None
        samples = np.empty(len(rows), sample_dtype(robot.n, reference=target is not None))
        samples["stamp_ns"] = rows["stamp_ns"]
        motor = np.empty((3, len(samples), robot.n))
        for i, drive in enumerate(bus.drives):
            position = rows["position"][:, i]
            before, by = last[i] if i < len(last) else (int(position[0]), 0)
            counts = (
                np.unwrap(np.insert(position, 0, before), period=1 << drive.position.bits)[1:] + by
            )
            last[i : i + 1] = [(int(position[-1]), int(counts[-1] - position[-1]))]
            motor[0, :, i] = drive.position_codec.si(counts)
            motor[1, :, i] = drive.effort.si(rows["effort"][:, i])
            if target is not None:
                away = np.rint((counts - target[:, i]) / (1 << drive.target.bits)).astype(np.int64)
                motor[2, :, i] = drive.position_codec.si(target[:, i] + (away << drive.target.bits))
        samples["position"] = robot.joint_position(motor[0])
        samples["effort"] = robot.joint_effort(motor[1])
        if target is not None:
            samples["reference"] = robot.joint_position(motor[2])
        yield samples
