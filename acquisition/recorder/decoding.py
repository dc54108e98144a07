"""CAN frames → joint samples on the grid of SYNC, vectorised.

A drive samples at SYNC and sends its PDO afterwards, so the time of a sample is that of its SYNC. `sync_times` computes the
times, `association` assigns each PDO to the SYNC that it answers.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Ints
from ..errors import AcquisitionError
from ..protocol import Pdo
from ..recording import SENT, Block, sample_dtype
from ..robot import Bus, Robot
from .association import SyncGrid, answers, sync_steps
from .sync_times import SyncTimes, sync_times
from .traffic import Traffic

LARGEST_PERIOD_ERROR = 0.05  # of the described SYNC period
FEWEST_SYNCS = 10  # with fewer their period is not checked
FEWEST_TARGETS = 0.1  # of the SYNCs; with fewer there is no reference


@dataclass(frozen=True, kw_only=True)
class PdoCount:
    """Frames of one PDO: received, late, duplicate and too short ones, and SYNCs without one between the first and the last."""

    name: str
    received: int
    late: int
    duplicate: int
    missing: int
    short: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Decoded:
    """Joint samples, and counters that tell how complete and how even they are.

    Attributes:
        samples: rows of `sample_dtype`; SYNCs that a drive did not answer are left out.
        raw: (N, n, 2) position counts and effort integers of the same rows, as the drives sent them.
        syncs, syncs_lost: SYNC frames recorded; SYNCs that drives answered but that were not recorded.
        period_s: between SYNCs, pauses left out.
        jitter_s: standard deviation and worst deviation of the recorded times from even ones, between pauses.
        warnings: for the user, one line each.
    """

    samples: Block
    raw: Ints
    pdos: tuple[PdoCount, ...]
    syncs: int
    syncs_lost: int
    period_s: float
    jitter_s: tuple[float, float]
    warnings: tuple[str, ...]

    @property
    def counters(self) -> dict[str, float]:
        """Counters for `/health` of a recording, by name."""
        return {
            "syncs": self.syncs,
            "syncs_lost": self.syncs_lost,
            "sync_jitter_sd_s": self.jitter_s[0],
            "sync_jitter_worst_s": self.jitter_s[1],
            **{word: sum(getattr(p, word) for p in self.pdos) for word in ("late", "duplicate", "missing", "short")},
        }


def decode(frames: Block, robot: Robot, bus: Bus, place: str) -> Decoded:
    """Joint samples from the raw frames of one CAN channel.

    Parameters
    ----------
    frames : (m,) rows of `FRAME` in the order in which they were received.
    robot : from motors to joints.
    bus : the drives: their PDOs (CiA 301), position counts (6064h or as described) and effort object, with its rule.
    place : the file or session, in errors.

    Returns
    -------
    One sample for each SYNC that all drives answered: rad or m, and N m or N (A or V where no drive gain is known), at the
    joints; with `reference` where all drives were sent targets (607Ah or as described).

    Raises
    ------
    AcquisitionError
        With `place`: there is no SYNC, a drive never answered, fewer than two samples remain, or the SYNC period is not
        that of the description.
    """
    traffic = Traffic(frames)
    is_sync = traffic.ids == bus.file.sync_can_id
    sync_rows = np.flatnonzero(is_sync)
    if len(sync_rows) < 2:
        problem = f"{len(sync_rows)} SYNC (0x{bus.file.sync_can_id:X}) in {len(frames)} frames"
        raise AcquisitionError(problem, place=place, expected="many")
    before = np.cumsum(is_sync)
    carriers = _carriers(bus)
    rows, shorts = {}, {}
    for pdo in carriers:
        rows[pdo.can_id], shorts[pdo.can_id] = traffic.of(pdo)
        if not len(rows[pdo.can_id]):
            problem = f"no frame 0x{pdo.can_id:03X} of {pdo.length} bytes ({carriers[pdo]})"
            expected = "the drive's answers to SYNC; is it mapped and started?"
            raise AcquisitionError(problem, place=place, expected=expected)
    syncs, times = frames[sync_rows], frames["time_ns"][sync_rows]
    steps = sync_steps(syncs, times, list(rows.values()), before, frames)
    index_of = np.concatenate([[0], np.cumsum(steps[:-1])])
    grid = SyncGrid(before=before, index_of=index_of, size=int(index_of[-1]) + int(steps[-1]))
    ours = bool((syncs["flags"] & SENT).all())
    clock = sync_times(times, index_of, grid.size, ours=ours, nominal_ns=bus.period_ns)
    if len(times) >= FEWEST_SYNCS:
        _refuse_period(clock.period_s, bus, place)

    slots, counts = {}, []
    for pdo, name in carriers.items():
        found = answers(rows[pdo.can_id], grid, frames)
        slots[pdo.can_id] = found.slot
        counts.append(
            PdoCount(
                name=name,
                received=len(rows[pdo.can_id]),
                late=found.late,
                duplicate=found.duplicate,
                missing=found.missing,
                short=shorts[pdo.can_id],
            )
        )
    ok = np.all([slot >= 0 for slot in slots.values()], axis=0)
    answered = np.flatnonzero(ok)
    if len(answered) < 2:
        raise AcquisitionError(f"{len(answered)} SYNC answered by all drives", place=place, expected="many")

    n = robot.n
    raw = np.empty((2, n, len(answered)), np.int64)
    motor = np.empty((2, len(answered), n))
    counts_on = np.empty((n, len(answered)), np.int64)  # positions, continued where a counter wraps
    wrapped = []
    everywhere = len(answered) == grid.size
    for i, drive in enumerate(bus.drives):
        for k, entry in enumerate((drive.position, drive.effort.entry)):
            carrier = drive.carrier(entry, "tpdo")
            assert carrier is not None  # `resolve` refuses drives without one
            slot = slots[carrier.can_id]
            raw[k, i] = traffic.integers(slot if everywhere else slot[answered], carrier, entry)
        counts_on[i], wraps = unwrapped(raw[0, i], drive.position.bits)
        if len(wraps):
            first_s = (clock.stamps[answered[wraps[0]]] - clock.stamps[answered[0]]) * 1e-9
            wrapped.append(
                f"{drive.name}: its position counter wrapped {len(wraps)} times, first at {first_s:.4g} s: "
                "positions go on from there"
            )
        motor[0, :, i], motor[1, :, i] = drive.position_codec.si(counts_on[i]), drive.effort.si(raw[1, i])
    q, effort = robot.joint_position(motor[0]), robot.joint_effort(motor[1])
    targets, reference = _targets(traffic, grid, answered, bus, counts_on), None
    if targets is not None:  # before the first target the measured position stands in
        reference = np.where(targets.known[:, None], robot.joint_position(targets.motor), q)
    extras = [(drive, extra) for drive in bus.drives for extra in drive.extras]
    samples = np.empty(len(answered), sample_dtype(n, reference=reference is not None, extra=len(extras)))
    samples["stamp_ns"] = clock.stamps[answered]
    for k, (drive, extra) in enumerate(extras):
        carrier = drive.carrier(extra.entry, "tpdo")
        assert carrier is not None
        samples["extra"][:, k] = extra.si(traffic.integers(slots[carrier.can_id][answered], carrier, extra.entry))
    samples["position"], samples["effort"] = q, effort
    if reference is not None:
        samples["reference"] = reference
    lost = int(np.sum(steps - 1))
    return Decoded(
        samples=samples,
        raw=raw.transpose(2, 1, 0),
        pdos=tuple(counts),
        syncs=len(sync_rows),
        syncs_lost=lost,
        period_s=clock.period_s,
        jitter_s=clock.jitter_s,
        warnings=(*bus.warnings, *wrapped, *_warnings(counts, lost, clock, bus, answered)),
    )


def _carriers(bus: Bus) -> dict[Pdo, str]:
    """PDOs that hold positions, efforts and extra objects, each with its name for messages."""
    found = {}
    for drive in bus.drives:
        for entry in (drive.position, drive.effort.entry, *(extra.entry for extra in drive.extras)):
            pdo = drive.carrier(entry, "tpdo")
            if pdo is not None:
                found[pdo] = f"TPDO {pdo.number} of node {drive.node}, {drive.name}"
    return found


def unwrapped(counts: Ints, bits: int) -> tuple[Ints, Ints]:
    """Counts continued where a counter of `bits` wraps from one end to the other, and the rows at which it wraps.

    Between two answers no motor moves by half of the range of a counter, so a larger step is a wrap.
    """
    steps = np.diff(counts)
    wraps = np.flatnonzero(np.abs(steps) > 1 << (bits - 1))
    if not len(wraps):
        return counts, wraps
    turns = np.zeros(len(counts), np.int64)
    turns[wraps + 1] = -np.sign(steps[wraps])
    return counts + (np.cumsum(turns) << bits), wraps + 1


@dataclass(frozen=True, kw_only=True, eq=False)
class _Targets:
    """Targets in force at each sample: motor positions (N, n); whether all drives had got one yet, (N,)."""

    motor: Array
    known: NDArray[np.bool_]


def _targets(traffic: Traffic, grid: SyncGrid, answered: Ints, bus: Bus, counts_on: Ints) -> _Targets | None:
    """The last target sent before the SYNC of each sample, held until the next.

    A target wraps as the position does that follows it; of the counts it may mean, the one nearest `counts_on` is taken.
    None where a drive gets no targets, or only a few: a master that commands the state alone sends them too.
    """
    motor, known = np.empty((len(answered), len(bus.drives))), np.ones(len(answered), np.bool_)
    following = np.append(grid.index_of, grid.size)  # grid index of the SYNC after as many SYNC frames
    for i, drive in enumerate(bus.drives):
        pdo = drive.carrier(drive.target, "rpdo")
        rows = np.zeros(0, np.int64) if pdo is None else traffic.of(pdo)[0]
        if pdo is None or len(rows) < FEWEST_TARGETS * len(answered):
            return None
        slot = np.full(grid.size + 1, -1, np.int64)
        slot[following[grid.before[rows]]] = np.arange(len(rows))
        held = np.maximum.accumulate(slot[:-1])[answered]
        known &= held >= 0
        target = traffic.integers(rows, pdo, drive.target)[held]
        away = np.rint((counts_on[i] - target) / (1 << drive.target.bits)).astype(np.int64)
        motor[:, i] = drive.position_codec.si(target + (away << drive.target.bits))
    return _Targets(motor=motor, known=known) if known.any() else None


def _refuse_period(measured_s: float, bus: Bus, place: str) -> None:
    """Refuse a SYNC period that is not the described one: rates and filters are computed from the description."""
    stated_s = bus.file.sync_period_s
    if abs(measured_s / stated_s - 1) > LARGEST_PERIOD_ERROR:
        raise AcquisitionError(
            f"SYNC came every {measured_s * 1e3:.4g} ms; bus.sync_period_s = {stated_s:g} in robot.toml",
            place=place,
            expected=f"{measured_s:.3g}; correct robot.toml and import again, or make samples of a recording's frames by "
            "`robot-acquire decode LOG.mcap --robot CORRECTED.toml -o OUT.mcap`",
        )


def _warnings(counts: list[PdoCount], lost: int, clock: SyncTimes, bus: Bus, answered: Ints) -> list[str]:
    found = []
    nominal_s = bus.file.sync_period_s
    at_s = (clock.stamps - clock.stamps[answered[0]]) * 1e-9
    for k, by_s in clock.set_back:
        found.append(f"the clock was set back by {by_s:.3g} s at {at_s[k]:.4g} s: times go on as if it had not been")
    if abs(clock.period_s / nominal_s - 1) > 0.01:
        expected = f"expected {nominal_s * 1e3:g} ms as robot.toml says"
        found.append(f"SYNC came every {clock.period_s * 1e3:.4g} ms: {expected}")
    if len(clock.pauses):
        longest = clock.pauses[np.argmax(np.diff(clock.stamps)[clock.pauses])]
        found.append(
            f"SYNC paused {len(clock.pauses)} times for more than 1.5 periods, the longest "
            f"{(at_s[longest + 1] - at_s[longest]) * 1e3:.4g} ms at {at_s[longest]:.4g} s"
        )
    elif clock.jitter_s[1] > 0.5 * nominal_s:
        found.append(
            f"a SYNC came {clock.jitter_s[1] * 1e3:.3g} ms off its time: more than half a period of {nominal_s * 1e3:g} ms"
        )
    if lost:
        found.append(f"{lost} SYNC were answered but not recorded")
    missing = int(answered[-1] - answered[0] + 1 - len(answered))
    if missing:
        found.append(f"{missing} samples are missing in {int(np.count_nonzero(np.diff(answered) > 1))} gaps")
    for count in counts:
        losses = [f"{getattr(count, w)} {w}" for w in ("late", "duplicate", "missing", "short") if getattr(count, w)]
        if losses:
            found.append(f"{count.name}: {', '.join(losses)} of {count.received}")
    return found
