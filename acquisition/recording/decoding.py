"""CAN frames → joint samples on the grid of SYNC, vectorised.

A drive samples at SYNC and sends its PDO afterwards. So the timestamp of a PDO is of little use,
and a sample has the time of its SYNC:

    frames       SYNC  PDO A  PDO B      SYNC  PDO B  PDO A      SYNC  PDO A      SYNC  PDO B ...
    grid         0                       1                       2                3
    samples      0                       1                       -                3

1. **SYNC**: frames of SYNC without repeats and with a period (`recorded_syncs`). A step of several
   periods contains SYNCs that were not recorded (`sync_steps`); they have a place on the grid, too.
   Each place has a time, without the delays of reception (`sync_times`).
2. **Answers**: the PDO of each drive that answers a SYNC (`associate`), which may come after the
   next one. A SYNC without an answer of each drive, or with uncertain answers, gives no sample.
3. **Targets**: the target that a drive had at SYNC is the last one that was sent before.
4. **Samples**: the integers of the answers, where position counters continue across wraps. Codecs
   convert them to SI at the motor, and the motor matrix to SI at the joint. Samples are made block
   by block on demand, because those of an hour do not fit in memory: only the rows of their frames
   are kept.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ..arrays import Array, Bools, Ints
from ..errors import Location, holding
from ..files import kept
from ..protocol import ObjectEntry, Pdo
from ..robot import Bus, Drive, Robot
from .association import Answers, associate
from .rows import SENT, Block, Rows, Traffic, joint_samples, wraps_of
from .sync_grid import (
    Syncs,
    SyncTimes,
    counted_steps,
    recorded_syncs,
    sync_steps,
    sync_times,
    usual_period,
    without_repeats,
)
from .writer import RecordingWriter

MAX_PERIOD_ERROR = 0.05  # of the SYNC period in robot.toml
# A period is even if this share of the steps deviates from it by less than this part.
MAX_UNEVEN, MIN_EVEN_SHARE = 0.25, 0.75
MIN_SYNCS = 10  # with fewer, their period is not checked
# If a larger share of the PDOs of a drive is missing, wrong rows may look right. In a short
# recording so few missing ones are not counted as a share.
MAX_MISSING_SHARE, MAX_MISSING_COUNT = 0.05, 2
# More SYNCs without rows before the first row and after the last give a warning.
MAX_AT_ENDS, MAX_SHARE_AT_ENDS = 3, 0.02
LOSSES = ("late", "duplicate", "missing", "short")  # counters of PDOs
_AT_ONCE = 10_000  # samples
MIN_TARGET_SHARE = 0.1  # of the SYNCs; with fewer targets there is no reference


@dataclass(frozen=True, kw_only=True, eq=False)
class Decoded:
    """Joint samples, made on demand, and their completeness and jitter.

    Attributes:
        rows: for each PDO the (N,) frames of the samples. SYNCs without an answer of each drive, or
            with uncertain answers, are left out.
        stamps: (N,) times of the SYNCs in ns.
        late: (N,) whether a PDO that is missing or duplicate within the next `MAX_RUN_SYNCS` would
            remove the row.
        targets: for each drive the (N,) frames of its current targets, -1 before the first; None
            without a reference.
        pdos: for each PDO, by its name, the number of frames `received`, and by `LOSSES` of those
            that were late, duplicate, too short, or missing between the first and the last SYNC.
        syncs: number of SYNC frames recorded.
        syncs_lost: number of SYNCs that were not recorded.
        jitter_s: standard and largest deviation of the recorded times from uniform ones, between
            pauses.
        warnings: warnings for the user, one line each.
    """

    traffic: Traffic
    robot: Robot
    bus: Bus
    rows: Mapping[Pdo, Rows]
    stamps: Ints
    late: Bools
    targets: list[Rows] | None
    pdos: Mapping[str, Counter[str]]
    syncs: int
    syncs_lost: int
    jitter_s: tuple[float, float]
    warnings: tuple[str, ...]

    @cached_property
    def samples(self) -> Block:
        """All samples at once, rows of `sample_dtype`."""
        return np.concatenate(list(self.blocks()))

    def blocks(self) -> Iterator[Block]:
        """Yield rows of `sample_dtype`, some thousands at a time."""
        begin = (
            0
            if self.targets is None
            else int(np.maximum.reduce([np.argmax(t >= 0) for t in self.targets]))
        )
        for samples in joint_samples(self._raw(), self.robot, self.bus):
            if begin > 0:
                samples["reference"][:begin] = samples["position"][:begin]
                begin -= len(samples)
            yield samples

    def _raw(self) -> Iterator[Block]:
        """Yield the integers of the drives, as `joint_samples` needs them."""
        names = ["position", "effort", *["target"] * (self.targets is not None)]
        layout = [("stamp_ns", "<i8"), *((name, "<i8", (self.robot.n,)) for name in names)]
        for first in range(0, len(self.stamps), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            raw = np.empty(len(self.stamps[part]), layout)
            raw["stamp_ns"] = self.stamps[part]
            for i, drive in enumerate(self.bus.drives):
                for name, entry in (("position", drive.position), ("effort", drive.effort.entry)):
                    raw[name][:, i] = _integers(self.traffic, self.rows, drive, entry, part)
                if self.targets is not None:
                    pdo = drive.carrier(drive.target, "rpdo")
                    assert pdo is not None
                    raw["target"][:, i] = self.traffic.integers(
                        np.maximum(self.targets[i][part], 0), pdo, drive.target
                    )
            yield raw

    def write(self, writer: RecordingWriter, stamp_ns: int) -> None:
        """Add samples, counters and warnings to a recording."""
        for block in self.blocks():
            writer.samples(block)
        writer.health(stamp_ns, self.counters)
        for text in self.warnings:
            writer.event(stamp_ns, "warning", text)

    @property
    def counters(self) -> dict[str, float]:
        """Counters for `/health` of a recording, by name."""
        return {
            "syncs": self.syncs,
            "syncs_lost": self.syncs_lost,
            "uncertain": self.syncs + self.syncs_lost - len(self.stamps),
            "sync_jitter_sd_s": self.jitter_s[0],
            "sync_jitter_worst_s": self.jitter_s[1],
            **{word: sum(count[word] for count in self.pdos.values()) for word in LOSSES},
        }


def decode(
    frames: Block, robot: Robot, bus: Bus, place: str, *, max_missing: float = MAX_MISSING_SHARE
) -> Decoded:
    """Decode joint samples from the raw frames of one CAN channel.

    There is one sample for each SYNC whose answers by all drives are known: rad or m, and N m or N
    (A or V if a drive gain is unknown), at the joints; with `reference` if all drives received
    targets (607Ah, or the object in robot.toml).

    Parameters
    ----------
    frames : (m,) rows of `FRAME` in the order in which they were received.
    robot : the robot.
    bus : its drives.
    place : name of the file or session in errors.
    max_missing : largest share of the PDOs of a drive that may be missing.

    Raises
    ------
    BadInputError : there is no SYNC, a drive never answered, too many PDOs are missing, fewer than
        two samples remain, or the SYNC period is not that of robot.toml.
    """
    traffic = Traffic(frames)
    times_of = partial(traffic.at, "time_ns")
    syncs = _syncs(traffic, bus, place)

    # Find the frames of each PDO that carries a position or an effort.
    carriers = _carriers(bus)
    pdos, repeats, short = zip(
        *(_frames_of(traffic, syncs, pdo, name, place) for pdo, name in carriers.items()),
        strict=True,
    )

    # Build the grid of SYNC: periods from each frame to the next, and the times of all.
    intervals = sync_steps(syncs, pdos, times_of)
    if (traffic.at("length", syncs.rows) >= 1).all():
        intervals = replace(intervals, steps=counted_steps(traffic.at("data", syncs.rows)[:, 0]))
    index_of = kept(np.concatenate([[0], np.cumsum(intervals.steps[:-1])]))
    clock = sync_times(syncs, index_of, int(intervals.steps.sum()), bus.period_ns)
    if len(syncs.rows) >= MIN_SYNCS:
        refuse_period(clock.period_s, bus.file.sync_period_s, place, np.diff(syncs.times) * 1e-9)

    # Find the frames that answer each SYNC.
    answers = associate(pdos, repeats, syncs, times_of, intervals)
    counts = {
        name: Counter(received=len(rows) + len(again), short=n, **lost)
        for name, rows, again, n, lost in zip(
            carriers.values(), pdos, repeats, short, answers.losses, strict=True
        )
    }
    # These arrays are large in a long session, and not needed any more.
    del pdos
    _refuse_missing(answers, max_missing, place)

    rows_of = dict(zip(carriers, map(kept, answers.rows), strict=True))
    stamps = kept(clock.stamps[answers.answered])
    syncs_lost = int(np.sum(intervals.steps - 1))
    return Decoded(
        traffic=traffic,
        robot=robot,
        bus=bus,
        rows=rows_of,
        stamps=stamps,
        late=answers.late,
        targets=_targets(traffic, syncs.rows, index_of, answers.answered, bus),
        pdos=counts,
        syncs=len(syncs.rows),
        syncs_lost=syncs_lost,
        jitter_s=clock.jitter_s,
        warnings=(
            *bus.warnings,
            *_wraps(traffic, bus, rows_of, stamps),
            *_warnings(counts, syncs_lost, clock, bus, answers.answered),
        ),
    )


def _syncs(traffic: Traffic, bus: Bus, place: str) -> Syncs:
    rows = traffic.rows_of(bus.file.sync_can_id)
    Location(place).require(
        len(rows) >= 2,
        text=f"only {len(rows)} of {len(traffic.frames)} frames are SYNC "
        f"(0x{bus.file.sync_can_id:X})",
        advice="Check sync_can_id in robot.toml, and that SYNC was sent",
    )
    times = traffic.at("time_ns", rows)
    return recorded_syncs(
        Syncs(
            rows=rows,
            times=times,
            ours=bool((traffic.at("flags", rows) & SENT).all()),
            period=usual_period(times, bus.period_ns),
        ),
        # Few recordings need these frames, so a generator finds them on demand.
        (traffic.of(pdo)[0] for pdo in _carriers(bus)),
    )


def _frames_of(
    traffic: Traffic, syncs: Syncs, pdo: Pdo, name: str, place: str
) -> tuple[Rows, Rows, int]:
    """Return the frames of a PDO, those that repeat one, and the number of those too short."""
    rows, short = traffic.of(pdo)
    rows, again = without_repeats(rows, syncs.rows, traffic.at("data", rows))
    Location(place).require(
        len(rows),
        text=f"no frame 0x{pdo.can_id:03X} of {pdo.length} bytes ({name}) was received",
        advice="Check that the drive maps this PDO, is started and answers SYNC",
    )
    return kept(rows), again, short


def _refuse_missing(answers: Answers, max_missing: float, place: str) -> None:
    """Refuse frames if too many are missing for certain rows, or if there are too few rows."""
    Location(place).require(
        answers.missing_share <= max_missing
        or all(lost["missing"] <= MAX_MISSING_COUNT for lost in answers.losses),
        text=f"{answers.missing_share:.1%} of the PDOs of a drive are missing, more than "
        f"{max_missing:.0%}, so it is uncertain which PDOs belong together",
        advice="Record again with fewer lost frames",
    )
    Location(place).require(
        len(answers.answered) >= 2,
        text=f"all drives answered only {len(answers.answered)} SYNC; samples need at least 2",
        advice="Check that all drives are started, and record for longer",
    )


def _integers(
    traffic: Traffic,
    rows: Mapping[Pdo, Rows],
    drive: Drive,
    entry: ObjectEntry,
    part: slice = slice(None),
) -> Ints:
    """Return a part of the integers of a drive's object, in the `rows` of its PDO."""
    carrier = drive.carrier(entry, "tpdo")
    assert carrier is not None  # `resolve` refuses drives without one
    return traffic.integers(rows[carrier][part], carrier, entry)


def _carriers(bus: Bus) -> dict[Pdo, str]:
    """Return the PDOs that carry positions and efforts, each with its name for messages."""
    return {
        pdo: f"TPDO {pdo.number} of node {drive.node}, {drive.name}"
        for drive in bus.drives
        for entry in (drive.position, drive.effort.entry)
        if (pdo := drive.carrier(entry, "tpdo")) is not None
    }


def _wraps(traffic: Traffic, bus: Bus, rows_of: Mapping[Pdo, Rows], stamps: Ints) -> Iterator[str]:
    """Yield warnings about position counters that wrapped."""
    for drive in bus.drives:
        position = _integers(traffic, rows_of, drive, drive.position)
        if len(wraps := wraps_of(position, drive.position.bits)):
            yield (
                f"{drive.name}: the position counter wrapped {len(wraps)} times, first at "
                f"{(stamps[wraps[0]] - stamps[0]) * 1e-9:.4g} s: positions continue across it"
            )


def _targets(
    traffic: Traffic, sync_rows: Rows, index_of: Ints, answered: Rows, bus: Bus
) -> list[Rows] | None:
    """Return the frame of each drive's last target before the SYNC of a sample.

    The frame is -1 if there is none. The result is None if a drive receives no or few targets.
    """
    # The k-th entry is the grid index of the SYNC that follows k SYNC frames.
    targets, following = [], np.append(index_of, index_of[-1] + 1)
    for drive in bus.drives:
        pdo = drive.carrier(drive.target, "rpdo")
        rows = np.zeros(0, np.int32) if pdo is None else traffic.of(pdo)[0]
        if len(rows) < MIN_TARGET_SHARE * len(answered):
            return None
        row = np.full(following[-1] + 1, -1, np.int32)
        row[following[np.searchsorted(sync_rows, rows)]] = rows
        targets.append(np.maximum.accumulate(row)[answered])
    return targets if all((frames >= 0).any() for frames in targets) else None


def refuse_period(
    measured_s: float, stated_s: float, place: str, steps_s: Array, what: str = "SYNC"
) -> None:
    """Refuse a period other than that of robot.toml, from which rates and filters are computed.

    It is wrong only if most steps are as long as the measured period.

    Parameters
    ----------
    measured_s : measured period in s.
    stated_s : period in robot.toml in s.
    place : name of the recording in errors.
    steps_s : (k,) steps between the times in s.
    what : name of what has the period.
    """
    if abs(measured_s / stated_s - 1) <= MAX_PERIOD_ERROR:
        return
    low, high = np.quantile(steps_s, [0.1, 0.9]) * 1e3
    even = np.quantile(np.abs(steps_s / measured_s - 1), MIN_EVEN_SHARE) <= MAX_UNEVEN
    came = (
        f"every {measured_s * 1e3:.4g} ms"
        if even
        else f"{low:.3g} to {high:.3g} ms after the previous one"
    )
    Location(place).refuse(
        text=f"{what} came {came}, but bus.sync_period_s is {stated_s:g} in robot.toml",
        advice=f"Set it to {measured_s:.3g} and import again; for a recording: "
        "`robot-acquire import LOG.mcap --robot CORRECTED.toml -o OUT.mcap`"
        if even
        else "Check whether each is recorded twice, or in another order or clock than it came",
    )


def _warnings(
    counts: Mapping[str, Counter[str]], lost: int, clock: SyncTimes, bus: Bus, answered: Rows
) -> list[str]:
    nominal_s = bus.file.sync_period_s
    at_s = (clock.stamps - clock.stamps[answered[0]]) * 1e-9
    pauses = len(clock.pauses)
    longest = clock.pauses[np.argmax(np.diff(clock.stamps)[clock.pauses])] if pauses else 0
    missing = int(answered[-1] - answered[0] + 1 - len(answered))
    at_ends = len(clock.stamps) - int(answered[-1] - answered[0] + 1)
    notes = {
        f"SYNC came every {clock.period_s * 1e3:.4g} ms, not every {nominal_s * 1e3:g} ms as "
        "in robot.toml: correct sync_period_s": abs(clock.period_s / nominal_s - 1) > 0.01,
        f"SYNC paused {pauses} times for more than 1.5 periods, the longest for "
        f"{(at_s[longest + 1] - at_s[longest]) * 1e3:.4g} ms at {at_s[longest]:.4g} s: samples are "
        "missing there": pauses,
        f"a SYNC came {clock.jitter_s[1] * 1e3:.3g} ms off its time, more than half a period of "
        f"{nominal_s * 1e3:g} ms": not pauses and clock.jitter_s[1] > 0.5 * nominal_s,
        f"{lost} SYNC were answered but not recorded: their times are interpolated": lost,
        f"{missing} samples are missing in {np.count_nonzero(np.diff(answered) > 1)} gaps": missing,
        f"{at_ends} of {len(clock.stamps)} SYNC at the beginning and the end give no samples": (
            at_ends > max(MAX_AT_ENDS, MAX_SHARE_AT_ENDS * len(clock.stamps))
        ),
    }
    return [
        *(
            f"the clock was set back by {by_s:.3g} s at {at_s[k]:.4g} s: later times are shifted "
            "forward"
            for k, by_s in clock.set_back
        ),
        *holding(notes),
        *(
            f"{name}: {losses} of {count['received']} received"
            for name, count in counts.items()
            if (losses := ", ".join(f"{count[word]} {word}" for word in LOSSES if count[word]))
        ),
    ]
