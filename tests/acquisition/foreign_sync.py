"""Made-up recordings with SYNC of another producer that is received with delays, doubled or not at
all; their times and answers are known.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.recording import FRAME, SENT, Block, Decoded, decode

PERIOD_NS = 1_000_000
ROBOT = robot_of(bus_text(2, period_s=1e-9 * PERIOD_NS))
BUS = bus_of(ROBOT)


@dataclass(frozen=True, kw_only=True, eq=False)
class Made:
    """Frames; the SYNC that each one is or answers; for each SYNC the time at which the drives
    sampled and that at which it was received, in periods.
    """

    frames: Block
    answers: np.ndarray
    true: np.ndarray
    received: np.ndarray

    def decoded(self) -> tuple[Decoded, np.ndarray, np.ndarray, np.ndarray]:
        """What is found, the SYNC of each row, the errors of its stamp and of the receive time."""
        found = decode(self.frames, ROBOT, BUS, "log")
        first, second = (self.answers[rows] for rows in found.rows.values())
        assert (first == second).all()
        stamps = (found.stamps - 10**9) / PERIOD_NS
        return found, first, stamps - self.true[first], (self.received - self.true)[first]


def of_frames(
    parts: Sequence[tuple[np.ndarray, np.ndarray, int]],
    true: np.ndarray,
    received: np.ndarray,
    *,
    sent: bool = False,
    keep: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Made:
    """`parts`: times in periods, the SYNCs they are or answer, and whose: 0 SYNC, else a node."""
    when, which = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    whose = np.concatenate([np.full(len(part[0]), part[2]) for part in parts])
    if keep is not None:
        kept = keep(which, whose)
        when, which, whose = when[kept], which[kept], whose[kept]
    order = np.argsort(when, kind="stable")
    when, which, whose = when[order], which[order], whose[order]
    frames = np.zeros(len(when), FRAME)
    frames["time_ns"] = 10**9 + np.rint(when * PERIOD_NS).astype(np.int64)
    frames["can_id"] = np.where(whose == 0, 0x80, 0x180 + whose)
    frames["length"] = 8 * (whose > 0)
    frames["flags"] = SENT * (sent & (whose == 0))
    frames["data"][:, 2] = which % 251 * (whose > 0)
    return Made(frames=frames, answers=which, true=true, received=received)


def jittery(
    seed: int,
    sd: float,
    *,
    syncs: int = 300,
    doubled: float = 0.0,
    lost: float = 0.0,
    missing: float = 0.0,
    restart: float = 0.0,
    pauses: int = 0,
) -> Made:
    """SYNC and the answers to it are received late by the same half-normal delay of `sd` periods;
    shares of SYNCs that are doubled, and of SYNCs and PDOs that are not recorded; half way the
    producer restarts its timer so many periods early, and it pauses.
    """
    rng, k = np.random.default_rng(seed), np.arange(syncs)
    true = k - restart * (k >= syncs // 2)
    for first in rng.integers(syncs // 4, 3 * syncs // 4, pauses).tolist():
        true = true + rng.uniform(0.7, 30) * (k >= first)
    received = np.maximum.accumulate(true + np.abs(rng.normal(0, sd, syncs)))
    parts = [(received + by, k, node) for node, by in enumerate((0, 0.11, 0.17))]
    again = np.flatnonzero(rng.random(syncs) < doubled)
    parts.append((received[again] + 0.3 * rng.random(len(again)), again, 0))
    gone = np.flatnonzero(rng.random(syncs) < lost)

    def keep(which: np.ndarray, whose: np.ndarray) -> np.ndarray:
        kept = rng.random(len(which)) >= missing
        return np.where(whose > 0, kept, ~np.isin(which, gone))

    return of_frames(parts, true, received, keep=keep)
