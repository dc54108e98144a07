"""Datagrams of process data: which repeat others, which belong to one cycle, the integers in them."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import Ints
from ..protocol import ObjectEntry
from ..recording import minimum_ahead
from .captures import Datagrams

MAX_OFF = 0.25  # of a period: a step that is no further from whole periods counts them
MIN_SHARE = 0.5  # of the rows: with fewer there is no reference, and no clock but the capture's
_ORDER = 15  # rows before and after a stamp that must not contradict it

Bools: TypeAlias = NDArray[np.bool_]


def doubled(found: Datagrams, time_ns: Ints, period: int) -> Bools:
    """Datagrams that repeat the one before within half a period, index and all."""
    again = np.zeros(len(found.packet), np.bool_)
    if len(again):
        rows, number = found.rows(), found.data[found.at - 9]
        same = (
            (rows[1:] == rows[:-1]).all(axis=1)
            & (number[1:] == number[:-1])
            & (found.counter[1:] == found.counter[:-1])
        )
        again[1:] = same & (np.abs(np.diff(time_ns[found.packet])) < period // 2)
    return again


def in_order(time_ns: Ints) -> Bools:
    """Stamps that no other of the 15 before and after contradicts."""
    return np.asarray(
        (time_ns <= minimum_ahead(time_ns, _ORDER)) & (time_ns >= -minimum_ahead(-time_ns[::-1], _ORDER)[::-1])
    )


def join(packet: Ints, other: Ints, time_ns: Ints, period: int) -> tuple[Ints, Bools]:
    """For each packet the other one of its cycle, and whether that is certain.

    It is the same packet, or the nearest in time if both came regularly, before and after.
    """
    if not len(other):
        return np.zeros(len(packet), np.int64), np.zeros(len(packet), np.bool_)
    index = np.minimum(np.searchsorted(other, packet), len(other) - 1)
    same = other[index] == packet
    if same.mean() > MIN_SHARE:
        return index, same
    t, u = time_ns[packet], time_ns[other]
    index = np.clip(np.searchsorted(u, t), 1, max(1, len(u) - 1))
    index = np.minimum(index - (t - u[index - 1] < u[np.minimum(index, len(u) - 1)] - t), len(u) - 1)
    near = np.abs(u[index] - t) < MAX_OFF * period
    return index, near & _regular(t, period) & _regular(u, period)[index]


def _regular(time_ns: Ints, period: int) -> Bools:
    steps = np.abs(np.diff(time_ns) - period) < MAX_OFF * period
    return np.asarray(np.concatenate([[False], steps]) & np.concatenate([steps, [False]]))


def integers(found: Datagrams, offset: int, entry: ObjectEntry) -> Ints:
    """The integers of an object that begins at byte `offset` of the data."""
    size = entry.bits // 8
    raw = found.data[(found.at + offset)[:, None] + np.arange(size)]
    return np.asarray(raw.reshape(-1).view(f"<{entry.type[0].lower()}{size}"), np.int64)
