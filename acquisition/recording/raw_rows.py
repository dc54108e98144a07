"""Integers of the drives, row by row → joint samples."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Ints
from ..robot import Bus, Robot
from .rows import Block, sample_dtype


@dataclass(frozen=True, kw_only=True, eq=False)
class RawRows:
    """Integers of the drives: stamps (m,) in ns; by drive position, effort, and target (m,), no target without a reference.

    Rows before `targets_from` have no target yet.
    """

    stamp_ns: Ints
    position: Sequence[Ints]
    effort: Sequence[Ints]
    target: Sequence[Ints] = ()
    targets_from: int = 0


def joint_samples(raw: Iterable[RawRows], robot: Robot, bus: Bus) -> Iterator[Block]:
    """Rows of `sample_dtype` of consecutive rows. Position counters that wrap count on; targets wrap as the position does."""
    last: dict[int, tuple[int, int]] = {}  # by drive: raw position of the row before, and the counts added to it
    for rows in raw:
        samples = np.empty(len(rows.stamp_ns), sample_dtype(robot.n, reference=bool(rows.target)))
        samples["stamp_ns"] = rows.stamp_ns
        motor = np.empty((3, len(samples), robot.n))
        for i, drive in enumerate(bus.drives):
            position, bits = rows.position[i], drive.position.bits
            before, by = last.get(i, (int(position[0]), 0))
            counts = unwrap(np.concatenate([[before], position]), bits)[0][1:] + by
            last[i] = int(position[-1]), int(counts[-1] - position[-1])
            motor[0, :, i] = drive.position_codec.si(counts)
            motor[1, :, i] = drive.effort.si(rows.effort[i])
            if rows.target:
                away = np.rint((counts - rows.target[i]) / (1 << bits)).astype(np.int64)  # the nearest one
                motor[2, :, i] = drive.position_codec.si(rows.target[i] + (away << bits))
        samples["position"] = robot.joint_position(motor[0])
        samples["effort"] = robot.joint_effort(motor[1])
        if rows.target:
            samples["reference"] = robot.joint_position(motor[2])
            samples["reference"][: rows.targets_from] = samples["position"][: rows.targets_from]
        yield samples


def unwrap(counts: Ints, bits: int) -> tuple[Ints, Ints]:
    """Counts without the wraps of a counter of `bits`, and the rows at which it wraps.

    No motor moves by half of a counter's range between two answers, so a larger step is a wrap.
    """
    steps = np.diff(counts)
    wraps = np.flatnonzero(np.abs(steps) > 1 << (bits - 1))
    if not len(wraps):
        return counts, wraps
    turns = np.zeros(len(counts), np.int64)
    turns[wraps + 1] = -np.sign(steps[wraps])
    return counts + (np.cumsum(turns) << bits), wraps + 1
