"""Made-up lossy CAN recordings, each frame with the SYNC that it answers; shares no
code with the decoder.
"""

from dataclasses import dataclass, fields
from functools import cache

import numpy as np
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.errors import BadInputError
from acquisition.recording import FRAME, SENT, Block, decode
from acquisition.robot import Bus, Robot

SYNCS = 1000
# shares of PDOs that are doubled, of SYNCs that are doubled or swapped
COPIED, SWAPPED = 0.01, 0.01
DRIVES, PERIODS_MS = (2, 3, 6), (1, 2, 5, 10)


@dataclass(frozen=True, kw_only=True)
class Kind:
    """`sync`: doubled, swapped, lost; `silent`: pauses without a frame; `bursts`:
    frames in a row are lost.
    """

    late: bool = False
    lost: bool = False
    doubled: bool = False
    sync: str = ""
    silent: bool = False
    bursts: bool = False

    def __str__(self) -> str:
        words = [
            name for name in ("late", "lost", "doubled", "silent", "bursts") if getattr(self, name)
        ]
        return ", ".join(
            ["on time"] * (not self.late) + words + [f"SYNC {self.sync}"] * bool(self.sync)
        )


LATE, LOST = {"late": True}, {"lost": True}
MIXTURES: tuple[dict[str, bool], ...] = (
    {},
    LATE,
    LOST,
    LATE | LOST,
    {"doubled": True} | LATE | LOST,
)
KINDS = (
    *(Kind(**mixture) for mixture in MIXTURES),
    Kind(doubled=True),
    Kind(lost=True, doubled=True),
    Kind(late=True, doubled=True),
    *(
        Kind(sync=sync, **mixture)
        for sync in ("lost", "doubled", "swapped")
        for mixture in MIXTURES
    ),
    *(Kind(silent=True, **mixture) for mixture in MIXTURES),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Made:
    """Frames; the SYNC that each one is or answers, as an index of `sync_ns`; the times at
    which the drives sampled.
    """

    frames: Block
    answers: np.ndarray
    sync_ns: np.ndarray
    n: int
    period_ms: int
    hold: int


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Counts of one recording, to be added up: rows `possible` are SYNCs with a recorded
    answer of every drive.
    """

    files: int = 1
    refused: int = 0
    possible: int = 0
    rows: int = 0
    mixed: int = 0
    off: int = 0

    def __add__(self, other: "Outcome") -> "Outcome":
        return Outcome(
            **{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)}
        )


@cache
def described(n: int, period_ms: int) -> tuple[Robot, Bus]:
    robot = robot_of(bus_text(n, period_s=period_ms * 1e-3))
    return robot, bus_of(robot)


def made(rng: np.random.Generator, kind: Kind) -> Made:
    """One recording: drives, period, who sends SYNC, and how much of everything are drawn."""
    hold = int(rng.choice([1, 1, 1, 4]))
    n, period_ms, ours = int(rng.choice(DRIVES)), int(rng.choice(PERIODS_MS)), bool(rng.integers(2))
    at = np.arange(SYNCS) + 0.01 * rng.random(SYNCS)  # in periods
    if kind.silent:
        for k in rng.integers(20, SYNCS - 20, int(rng.integers(1, 4))).tolist():
            at[k:] += int(rng.integers(2, 120))
    # times, the SYNCs that they are or answer, and whose: a drive, or SYNC
    parts = [(at, np.arange(SYNCS), -1)]
    lateness = 10 ** rng.uniform(-3, -1.3) if rng.random() < 0.7 else rng.uniform(0.05, 0.3)
    # a drive stays late for so many SYNCs
    reach, run = rng.uniform(0.3, 1.5), int(rng.choice([1, 1, 1, 3, 20]))
    for i in range(n):
        even = rng.random() < 0.5
        jitter = (
            0.1 * rng.random(SYNCS) if even else rng.normal(0.05, rng.choice([0.005, 0.03]), SYNCS)
        )
        delay = rng.uniform(0.03, 0.5) + np.abs(jitter)
        if kind.late:
            is_late = np.repeat(rng.random(SYNCS // run + 1) < lateness, run)[:SYNCS]
            delay = np.where(is_late, 0.9 + reach * rng.random(SYNCS), delay)
        step = 1e-3 * np.arange(SYNCS)  # two frames of one drive
        came = np.maximum.accumulate(at + delay - step) + step
        parts.append((came, np.arange(SYNCS), i))
        if kind.doubled:
            copied = np.flatnonzero(rng.random(SYNCS) < COPIED)
            after = rng.choice([1e-4, 0.3], len(copied)) * rng.random(len(copied))
            # a drive repeats before it sends the next
            last = np.append(came[1:], np.inf)[copied] - 1e-5
            parts.append((np.minimum(came[copied] + after, last), copied, i))
    if kind.sync == "doubled":
        copied = np.flatnonzero(rng.random(SYNCS) < COPIED)
        parts.append((at[copied] + rng.choice([1e-3, 0.3]) * rng.random(len(copied)), copied, -1))
    when, which = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    whose = np.concatenate([np.full(len(times), i) for times, _, i in parts])
    order = np.argsort(when, kind="stable")
    whose, which, when = whose[order], which[order], when[order]
    keep = np.ones(len(when), bool)
    if kind.lost:
        share = 10 ** rng.uniform(np.log10(0.0005), np.log10(0.05))
        keep = (rng.random(len(when)) >= share) | (whose < 0) & (kind.sync != "lost")
    elif kind.sync == "lost":
        keep = (whose >= 0) | (rng.random(len(when)) >= 0.01)
    if kind.bursts:
        for k in rng.integers(0, len(when), 5).tolist():
            keep[k : k + int(rng.integers(3, 31))] = False
        keep[: int(rng.integers(60))] = keep[-int(rng.integers(1, 60)) :] = False
    whose, which, when = whose[keep], which[keep], when[keep]
    if kind.sync == "swapped":
        chosen = np.flatnonzero((whose < 0) & (rng.random(len(when)) < SWAPPED))
        stamped = "each" if ours else rng.choice(["each", "later"])
        for a, b in zip(
            chosen.tolist(), (chosen + rng.choice([-1, 1], len(chosen))).tolist(), strict=True
        ):
            if not 0 <= b < len(when):
                continue
            whose[[a, b]], which[[a, b]] = whose[[b, a]], which[[b, a]]
            if stamped == "each":
                when[[a, b]] = when[[b, a]]
            elif stamped == "later":  # an adapter that has both before it hands over the first
                when[[a, b]] = when[max(a, b)]
    start_ns, period_ns = 10**9, period_ms * 1_000_000
    frames = np.zeros(len(when), FRAME)
    frames["time_ns"] = start_ns + np.rint(when * period_ns)
    frames["can_id"] = np.where(whose < 0, 0x80, 0x181 + whose)
    frames["length"] = np.where(whose < 0, 0, 8)
    frames["flags"] = SENT * (ours & (whose < 0))
    payload = frames["data"].view([("status", "<u2"), ("position", "<i4"), ("effort", "<i2")])[:, 0]
    payload["position"] = value(which, hold) * (whose >= 0)
    sync_ns = start_ns + np.rint(at * period_ns).astype(np.int64)
    return Made(frames=frames, answers=which, sync_ns=sync_ns, n=n, period_ms=period_ms, hold=hold)


def value(answered: np.ndarray, hold: int) -> np.ndarray:
    """Position that drives send: a slow motion has the same in `hold` SYNCs in a row."""
    return answered // hold


def outcome(recording: Made) -> Outcome:
    """Rows that decoding gives: mixed, if drives answer different SYNCs; off, if its time
    is not that of the SYNC.
    """
    robot, bus = described(recording.n, recording.period_ms)
    ids = recording.frames["can_id"]
    each = [
        np.bincount(recording.answers[ids == 0x181 + i], minlength=SYNCS) > 0
        for i in range(recording.n)
    ]
    possible = int(np.logical_and.reduce(each).sum())
    try:
        found = decode(recording.frames, robot, bus, "log")
    except BadInputError:
        return Outcome(refused=1)
    which = np.array([recording.answers[rows] for rows in found.rows.values()])
    positions = value(which, recording.hold)
    mixed = (positions != positions[0]).any(axis=0)
    off = np.abs(found.stamps - recording.sync_ns[which]).min(axis=0) > 0.5e6 * recording.period_ms
    return Outcome(
        possible=possible, rows=len(mixed), mixed=int(mixed.sum()), off=int((off & ~mixed).sum())
    )


def table(outcomes: dict[Kind, Outcome]) -> str:
    """Of each kind the files, those that are refused, rows, mixed ones, ones off in time, and
    the share that is kept.
    """
    lines = [
        "| kind | files | refused | rows | mixed | off | kept |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, o in (*outcomes.items(), ("all", sum(outcomes.values(), Outcome(files=0)))):
        lines.append(
            f"| {name} | {o.files} | {o.refused} | {o.rows} | {o.mixed} | {o.off} | "
            f"{o.rows / max(1, o.possible):.4f} |"
        )
    return "\n".join(lines)


def outcomes(seed: int, each: int) -> dict[Kind, Outcome]:
    """`each` recordings of every kind."""
    found = {}
    for k, kind in enumerate(KINDS):
        made_of = (made(np.random.default_rng([seed, k, j]), kind) for j in range(each))
        found[kind] = sum(map(outcome, made_of), Outcome(files=0))
    return found
