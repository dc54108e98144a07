"""The joint states of a topic, collected; they are refused if several publishers send them."""

from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np

from ..arrays import Array, Ints
from ..errors import BadInputError, Location, holding, listed
from ..files import BLOCK_ROWS, GrowingBytes, by_rows
from .stamps import smallest_difference

KINDS = ("position", "velocity", "effort")
# A controller that starts again may name joints in another order, but two publishers change it all
# the time. So one change is accepted, and this share of the messages.
MAX_CHANGES = 1e-3
WINDOW = 16  # rows; a divisor of `BLOCK_ROWS`
# Noise and motion rarely exceed this ratio of the energies at the Nyquist frequency and at half of
# it.
MIN_NYQUIST_RATIO = 100.0
# Larger shares of the windows, or of the rows, show two publishers.
MAX_ALTERNATING, MAX_WITHOUT_EFFORT = 0.1, 0.01
ONE_PUBLISHER = "Record the topic of the arm's own driver, or stop the other publisher"
MIN_PUBLISHER_QUANTA = 3.0  # smallest difference of two publishers, in quanta


class JointStates:
    """Collector of joint states.

    Messages of one publisher have one frame, and the names of all joints.
    """

    def __init__(self, joints: Sequence[str], place: Location) -> None:
        self._joints, self.place = list(joints), place
        self._places: dict[tuple[str, tuple[str, ...]], list[int] | None] = {}
        self._source: tuple[str, tuple[str, ...]] | None = None
        self._layout = np.dtype(
            [
                ("received", "<i8"),
                ("stamp", "<i8"),
                *((kind, "<f8", (len(joints),)) for kind in KINDS),
            ]
        )
        # Messages are stored as rows of `_layout`, because Python objects take six times the
        # memory.
        self._rows, self._without = GrowingBytes(), np.full(len(joints), np.nan).tobytes()
        self._given = dict.fromkeys(KINDS, 0)
        self.count, self._others, self._changes, self.publishers = 0, 0, 0, 1
        self.refused: BadInputError | None = None

    @property
    def names(self) -> list[str]:
        """All names in the messages."""
        return sorted({name for _, names in self._places for name in names})

    def add(self, received_ns: int, message: Any) -> None:
        """Add a message."""
        self.count += 1
        source = (message.header.frame_id, tuple(message.name))
        if source not in self._places:
            self._places[source] = self._checked(source)
        if (places := self._places[source]) is None:
            self._others += 1
            return
        self._changes += self._source not in (None, source)
        self._source, stamp = source, message.header.stamp
        row = np.array([received_ns, stamp.sec * 10**9 + stamp.nanosec], "<i8").tobytes()
        for kind in KINDS:
            content = np.asarray(getattr(message, kind, ()), "<f8")
            if len(content) not in (0, len(source[1])) or (kind == "position" and not len(content)):
                self._refuse_message(
                    f"it has {len(content)} values of {kind} for {len(source[1])} names",
                    "Record a topic with one value for each name",
                )
            row += content[places].tobytes() if len(content) else self._without
            self._given[kind] += len(content) > 0
        self._rows.write(row)

    def _checked(self, source: tuple[str, tuple[str, ...]]) -> list[int] | None:
        """Return the indices of the joints in messages of a source; None if it has none of them."""
        names = source[1]
        missing = [joint for joint in self._joints if joint not in names]
        if len(missing) == len(self._joints) and self._joints:
            return None
        if missing:
            self._refuse_message(
                f"the joints {listed(missing)} are missing; it has {listed(names)}",
                "Use the joint names of the messages in robot.toml",
            )
        if self._source is not None and source[0] != self._source[0]:
            self._refuse_message(
                f"several publishers sent messages: frame {source[0]!r} after {self._source[0]!r}",
                ONE_PUBLISHER,
            )
        return [names.index(joint) for joint in self._joints]

    def _refuse_message(self, problem: str, advice: str) -> NoReturn:
        Location(f"{self.place}: message {self.count}").refuse(text=problem, advice=advice)

    def states(self, topic: str) -> tuple[Ints, bool, dict[str, Array], list[str]]:
        """Return timestamps (N,) in ns, whether these are reception times, arrays, and warnings.

        The arrays have the shape (N, n). Timestamps are reception times if headers have none.
        """
        if self.refused is not None:
            raise self.refused
        rows = np.frombuffer(self._rows.whole(), self._layout)
        self.place.require(
            len(rows),
            text=f"the messages have the joints {listed(self.names)}"
            if self.names
            else "the topic has no messages",
            advice=f"Record a topic with the joints of robot.toml: {listed(self._joints)}",
        )
        stamps, count = rows["stamp"].astype(np.int64), len(rows)
        received = not stamps.any()
        # A clock that begins at 0 gives the first timestamp 0.
        if not received and not stamps[1:].all():
            Location(f"{self.place}: state {2 + int(np.argmin(stamps[1:] != 0))}").refuse(
                text="its header has no timestamp, but other headers have one",
                advice=ONE_PUBLISHER,
            )
        for kind, given in self._given.items():
            self.place.require(
                given in (0, count),
                text=f"only {given} of {count} messages have values of {kind}",
                advice=ONE_PUBLISHER,
            )
        arrays = {kind: rows[kind] for kind, given in self._given.items() if given}
        needed = {kind: x for kind, x in arrays.items() if kind != "velocity"}
        # If no row has all values, the first one is refused below.
        first = int(np.argmin(np.any([np.isnan(x).any(axis=1) for x in needed.values()], axis=0)))
        for kind, x in needed.items():
            _refuse_infinite(kind, x, first, self._joints, self.place)
        self.place.require(
            self._changes <= 1 + MAX_CHANGES * count,
            text=f"the joint names or their order change {self._changes} times in {count} messages",
            advice=ONE_PUBLISHER,
        )
        return (
            (rows["received"].astype(np.int64) if received else stamps)[first:],
            received,
            {kind: x[first:] for kind, x in arrays.items()},
            holding(
                {
                    "the headers have no timestamps: reception times are used, which jitter "
                    "more": received,
                    f"{topic} has {self.publishers} publishers (connections or QoS profiles), so "
                    "rows may be mixed: record it with one publisher": self.publishers > 1,
                    f"{self._others} messages without any of the joints are ignored": self._others,
                    f"the joint names or their order change {self._changes} times: values are "
                    "assigned to joints by name": self._changes,
                    f"the first {first} states are left out, because a position or an effort is "
                    "nan": first,
                }
            ),
        )


def _refuse_infinite(
    kind: str, x: Array, first: int, joints: Sequence[str], place: Location
) -> None:
    """Refuse numbers that are not finite in x (N, n) from the row `first` on."""
    finite = np.isfinite(x)
    for name, some in zip(joints, finite.T, strict=True):
        place.require(
            some.any(),
            f"{kind} of joint {name}",
            text="no row has a number",
            advice="Record measured positions and efforts",
        )
    if not finite[first:].all():
        row, joint = np.argwhere(~finite[first:])[0] + [first, 0]
        Location(f"{place}: state {row + 1}").refuse(
            f"{kind} of joint {joints[joint]}", float(x[row, joint]), "a finite number"
        )


def refuse_several_publishers(
    position: Array, effort: Array, joints: list[str], place: Location
) -> None:
    """Refuse alternating states of two publishers.

    Either single rows have no effort, or every other row is far from its neighbours.
    """
    least = MIN_PUBLISHER_QUANTA * smallest_difference(effort)
    large = by_rows(lambda x: (np.abs(x) > least).any(axis=1), effort) > 0
    single = np.asarray(~effort[1:-1].any(axis=1)) & large[:-2] & large[2:]
    if single.sum() > MAX_WITHOUT_EFFORT * len(effort):
        place.refuse(
            "effort",
            text=f"{100 * single.mean():.2g} % of the rows have no effort, but both neighbours do",
            advice=ONE_PUBLISHER,
        )
    for key, x in (("position", position), ("effort", effort)):
        share = _alternating_share(x)
        place.require(
            share.max() <= MAX_ALTERNATING,
            f"{key} of joint {joints[int(share.argmax())]}",
            text="every other row differs from its neighbours in "
            f"{100 * share.max():.2g} % of the time",
            advice=ONE_PUBLISHER,
        )


def _alternating_share(x: Array) -> Array:
    """Compute the share (n,) of windows of x (N, n) that alternate from row to row.

    The second differences of such a window have far more energy at the Nyquist frequency than at
    half of it. Rounded values sometimes alternate by one quantum, so several quanta are required.
    Values that are held for a row, for example by an encoder slower than the log, do not alternate.
    """
    least, rows = smallest_difference(x), max(0, len(x) - 2) // WINDOW * WINDOW
    found = sum(
        (
            _alternating(x[first : min(first + BLOCK_ROWS, rows) + 2], least)
            for first in range(0, rows, BLOCK_ROWS)
        ),
        np.zeros(x.shape[1]),
    )
    # Two such windows may be random.
    return np.maximum(found - 2, 0) / max(1, rows // WINDOW)


def _alternating(x: Array, least: Array) -> Array:
    """Count the windows in x (N + 2, n) that alternate (n,)."""
    steps, windows = (
        np.diff(x, n=n, axis=0)[: len(x) - 2].reshape(-1, WINDOW, x.shape[1]) for n in (1, 2)
    )
    energy = np.abs(np.fft.rfft(windows * np.hanning(WINDOW)[:, None], axis=1)) ** 2
    half = energy[:, WINDOW // 4 - 1 : WINDOW // 4 + 2].sum(axis=1)
    alternating = (
        (np.abs(windows).max(axis=1) > 4 * MIN_PUBLISHER_QUANTA * least)
        & ((steps == 0).mean(axis=1) < 0.4)
        & (energy[:, -2:].sum(axis=1) > MIN_NYQUIST_RATIO * half)
    )
    return np.asarray(alternating.sum(axis=0))
