"""`map.toml` as written in the file: which column of which table is what."""

from typing import Annotated, Literal

import msgspec
import numpy as np

from ..robot import EffortTiming, Positive

Side = Literal["motor", "joint"]
TablePlace = Annotated[int, msgspec.Meta(ge=1)]
Periods = Annotated[float, msgspec.Meta(ge=1.5)]

# Of each unit the SI unit that values are converted to, and the factor.
POSITION_UNITS = {
    "rad": ("rad", 1.0),
    "deg": ("rad", np.pi / 180),
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
}
VELOCITY_UNITS = {
    "rad/s": ("rad", 1.0),
    "deg/s": ("rad", np.pi / 180),
    "rpm": ("rad", np.pi / 30),
    "m/s": ("m", 1.0),
    "mm/s": ("m", 1e-3),
}
EFFORT_UNITS = {
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    "N m": ("N m", 1.0),
    "mN m": ("N m", 1e-3),
    "N": ("N", 1.0),
}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # in s

LARGEST_GAP_PERIODS = 3.0
FROM_VELOCITY = "from velocity"  # in place of the column of a counter


class Quantity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`[position]`, `[effort]` and the like: the columns, one per motor or joint, and what they are.

    Attributes:
        table: place of the file on the command line, from 1.
        columns: names, or numbers from 1.
        unit: one for all columns, or one for each.
        side: `motor` or `joint`; may be left out where it makes no difference or the unit decides.
    """

    columns: Annotated[tuple[str | int, ...], msgspec.Meta(min_length=1)]
    unit: str | tuple[str, ...]
    table: TablePlace = 1
    side: Side | None = None


class Time(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`[time]`: the column of sample times, or of a counter, and whether rows are interpolated to a uniform grid.

    Attributes:
        column, unit: times of the rows.
        ticks, tick_s: a counter and the time of one count; it is the time, `column` is then only compared with it. Ticks
            `FROM_VELOCITY` are counted by positions and recorded speeds.
        resample_hz: rate of the grid that all values are interpolated to.
        largest_gap_periods: longest step between two rows that is interpolated over, in periods of the rows.
    """

    column: str | int | None = None
    unit: str = "s"
    table: TablePlace = 1
    ticks: str | int | None = None
    tick_s: Positive | None = None
    resample_hz: Positive | None = None
    largest_gap_periods: Periods = LARGEST_GAP_PERIODS


class TableMap(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`map.toml`: where positions, efforts and what else was recorded are found, and the rate or the times of the samples.

    `effort_timing`: efforts are commands, each held from its sample to the next, means over the period about it, or were
    measured at its instant.
    """

    position: Quantity
    effort: Quantity
    reference: Quantity | None = None
    velocity: Quantity | None = None
    known_torque: Quantity | None = None
    feedforward: Quantity | None = None
    time: Time | None = None
    sample_rate_hz: Positive | None = None
    effort_timing: EffortTiming = "unknown"
