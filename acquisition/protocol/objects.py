"""Objects of CiA 301 and CiA 402: indices, types, codecs between raw integers and SI."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from ..arrays import Array, Ints
from ..errors import BadInputError

# Types of dictionaries by their number in CiA 301.
INTEGERS = {2: "I8", 3: "I16", 4: "I32", 5: "U8", 6: "U16", 7: "U32"}
BITS = {kind: int(kind[1:]) for kind in INTEGERS.values()}


@dataclass(frozen=True, kw_only=True)
class ObjectEntry:
    """An entry of the object dictionary: `type` is I8 to U32."""

    index: int
    sub: int
    type: str

    @property
    def bits(self) -> int:
        """Size in a PDO."""
        return BITS[self.type]

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.sub

    @property
    def mapping(self) -> int:
        """The entry in a PDO mapping parameter: index, sub-index, bits."""
        return self.index << 16 | self.sub << 8 | self.bits

    def __str__(self) -> str:
        return f"{self.index:04X}:{self.sub}"


EMERGENCY, HEARTBEAT = 0x80, 0x700  # CAN identifiers of CiA 301, plus the node id
CONTROLWORD, STATUSWORD = 0x6040, 0x6041
MODE_OF_OPERATION, MODE_DISPLAY = 0x6060, 0x6061
DEVICE_TYPE, CONSUMER_HEARTBEAT, HEARTBEAT_TIME = 0x1000, 0x1016, 0x1017  # of CiA 301
TEXTS = 0x1008, 0x1009, 0x100A  # device name, hardware version, software version
# when a drive loses the master: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop
ABORT_CONNECTION = 0x6007
STOP_OPTIONS = QUICK_STOP_OPTION, SHUTDOWN_OPTION, DISABLE_OPTION, FAULT_OPTION = (
    0x605A,
    0x605B,
    0x605C,
    0x605E,
)
FOLLOWING_ERROR_WINDOW, FOLLOWING_ERROR_TIME = 0x6065, 0x6066
PROFILE_DECELERATION, QUICK_STOP_DECELERATION = 0x6084, 0x6085
# Values of 605Ah with which a quick stop follows the ramp in an object; from 5 on
# it then stays active.
_RAMPS = {
    1: PROFILE_DECELERATION,
    2: QUICK_STOP_DECELERATION,
    5: PROFILE_DECELERATION,
    6: QUICK_STOP_DECELERATION,
}
VELOCITY_UNIT, _ACCELERATION_UNIT = 0x60A9, 0x60AA
RPM, _RPM_PER_S = 0x00B44700, 0x00C00300  # as coded by drives of maxon and Nanotec
RAMP_OBJECTS = (
    QUICK_STOP_OPTION,
    QUICK_STOP_DECELERATION,
    PROFILE_DECELERATION,
    _ACCELERATION_UNIT,
    VELOCITY_UNIT,
)
POSITION_ACTUAL, VELOCITY_ACTUAL, TARGET_POSITION = 0x6064, 0x606C, 0x607A
RATED_CURRENT, RATED_TORQUE = 0x6075, 0x6076
MOTION_LIMITS = POSITION_LIMITS, _MAX_VELOCITY, MAX_RPM = 0x607D, 0x607F, 0x6080
# encoder, gear, feed: each a ratio, sub-index 1 over sub-index 2
POSITION_UNITS = _, GEAR, _ = 0x608F, 0x6091, 0x6092
HOME_OFFSET, INTERPOLATION_PERIOD = 0x607C, 0x60C2
SUPPORTED_MODES = 0x6502

# Entries whose type CiA 402 (or 301) fixes.
STANDARD = {
    (index, 0): kind
    for kind, indices in {
        "U16": (CONTROLWORD, STATUSWORD, HEARTBEAT_TIME, FOLLOWING_ERROR_TIME),
        "I8": (MODE_OF_OPERATION, MODE_DISPLAY),
        "I32": (0x6062, 0x6063, POSITION_ACTUAL, VELOCITY_ACTUAL, TARGET_POSITION, 0x60F4, 0x60FC),
        "I16": (ABORT_CONNECTION, *STOP_OPTIONS, 0x6071, 0x6074, 0x6077, 0x6078, 0x60B2),
        "U32": (
            *(
                DEVICE_TYPE,
                FOLLOWING_ERROR_WINDOW,
                RATED_CURRENT,
                RATED_TORQUE,
                _MAX_VELOCITY,
                MAX_RPM,
            ),
            *(PROFILE_DECELERATION, QUICK_STOP_DECELERATION, SUPPORTED_MODES),
        ),
    }.items()
    for index in indices
}
STANDARD |= {
    (INTERPOLATION_PERIOD, 1): "U8",
    (INTERPOLATION_PERIOD, 2): "I8",
    (POSITION_LIMITS, 1): "I32",
    (POSITION_LIMITS, 2): "I32",
    **{(index, sub): "U32" for index in POSITION_UNITS for sub in (1, 2)},
}
# Further ones of CiA 301 and 402, which simulated drives without a dictionary do not need.
_MORE_TYPES = {
    (0x1029, 1): "U8",
    (0x1015, 0): "U16",
    (0x603F, 0): "U16",
    **{(index, 0): "U32" for index in (0x1002, 0x1005, 0x1006, 0x1007, 0x1014, *TEXTS)},
}


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Conversion of a raw integer to A, V, N m or N: raw · factor · the drive's value of the key
    `rated`, if any.
    """

    unit: str
    factor: float
    rated: str = ""


RULES = {
    "per mille of rated torque": Rule(unit="N m", factor=1e-3, rated="rated_torque_nm"),
    "per mille of rated current": Rule(unit="A", factor=1e-3, rated="rated_current_a"),
    "per mille of rated force": Rule(unit="N", factor=1e-3, rated="rated_force_n"),
    "mA": Rule(unit="A", factor=1e-3),
    "0.01 A": Rule(unit="A", factor=1e-2),
    "mV": Rule(unit="V", factor=1e-3),
    "mN m": Rule(unit="N m", factor=1e-3),
    "uN m": Rule(unit="N m", factor=1e-6),
    "mN": Rule(unit="N", factor=1e-3),
}

# Objects that hold a current or a torque: type, rule of the vendor's documentation, meaning.
EFFORT_OBJECTS = {
    (0x6074, 0): (
        "I16",
        "per mille of rated torque",
        "torque demand value, the reference of the current loop (CiA 402)",
    ),
    (0x6077, 0): ("I16", "per mille of rated torque", "torque actual value (CiA 402)"),
    (0x6078, 0): ("I16", "per mille of rated current", "current actual value (CiA 402)"),
    (0x30D0, 0): ("I32", "mA", "current demand value (maxon EPOS4)"),
    (0x2031, 0): ("I16", "mA", "current demand value (maxon EPOS2)"),
    (0x221E, 0): ("I16", "0.01 A", "commanded current (Copley)"),
}

# Units of the rated values in drives; 6076h is mN m by CiA 402, and uN m in an EPOS4.
RATED_UNITS = {"mA": 1e-3, "mN m": 1e-3, "uN m": 1e-6, "mN": 1e-3}


@dataclass(frozen=True, kw_only=True)
class EffortCodec:
    """Conversion of raw integers of `entry` to SI at the motor, `scale` per unit; `provenance`:
    source of the value.
    """

    entry: ObjectEntry
    scale: float
    provenance: str

    def si(self, raw: Ints) -> Array:
        """Return A, V, N m or N, of any shape."""
        return np.asarray(raw * self.scale, dtype=np.float64)

    def raw(self, value: Array) -> Ints:
        """Return the nearest raw integers, limited to the range of the object's type as in a
        drive.
        """
        return saturated(value / self.scale, self.entry.type)


@dataclass(frozen=True, kw_only=True)
class PositionCodec:
    """Conversion of counts of one or n motors to rad (or m): counts = zero_counts + sign ·
    counts_per_unit · position.
    """

    counts_per_unit: float | Array
    sign: int | Array
    zero_counts: int | Array

    def si(self, raw: Ints) -> Array:
        """Return the motor position in rad or m, of any shape."""
        return np.asarray(
            (raw - self.zero_counts) * (self.sign / self.counts_per_unit), dtype=np.float64
        )

    def exact(self, value: Array) -> Array:
        """Return counts without rounding and limits."""
        return np.asarray(
            value * (self.sign * self.counts_per_unit) + self.zero_counts, dtype=np.float64
        )

    def raw(self, value: Array) -> Ints:
        """Return the nearest counts, limited to 32 bits."""
        return saturated(self.exact(value), "I32")


def object_type(index: int, sub: int) -> str:
    """Return the type of an object that is known here, of any axis; else U8 for the count of a
    record of CiA 301, U32 for all others.
    """
    if index & 0xFE00 in (0x1400, 0x1800):  # communication parameters of PDOs
        return {0: "U8", 1: "U32", 3: "U16", 5: "U16"}.get(sub, "U8")
    # The objects of each further axis are 800h higher (CiA 402-2).
    first = 0x6000 | index & 0x7FF if 0x6000 <= index < 0xA000 else index
    return (
        STANDARD.get((first, sub))
        or EFFORT_OBJECTS.get((first, sub), ("",))[0]
        or _MORE_TYPES.get((first, sub))
        or ("U8" if index < 0x2000 and not sub else "U32")
    )


def size_of(index: int, sub: int) -> int:
    """Return the size of an object of `object_type` in bytes."""
    return BITS[object_type(index, sub)] // 8


def position_units_per_turn(values: Mapping[tuple[int, int], int | None]) -> float | None:
    """Return position units per motor turn: feed (6092h) over gear (6091h, else 1), or without a
    feed 608Fh.

    It is None if unknown.
    """
    encoder, gear, feed = (
        (values.get((i, 1)) or 0) / (values.get((i, 2)) or np.inf) for i in POSITION_UNITS
    )
    return (feed / (gear or 1.0) if feed else encoder) or None


def quick_stop_ramp(values: Mapping[int, int | None], codec: PositionCodec) -> float | None:
    """Return the quick stop deceleration that 605Ah selects, counts/s² of the motor; None if
    unknown.

    `values` are those of `RAMP_OBJECTS`. Units are those of the position, unless 60AAh or 60A9h
    gives rpm/s or rpm.
    """
    raw = values.get(_RAMPS.get(values.get(QUICK_STOP_OPTION) or 0, 0))
    unit = values.get(_ACCELERATION_UNIT) or values.get(VELOCITY_UNIT)
    if not raw or unit not in (None, 0, RPM, _RPM_PER_S):
        return None
    return raw * float(2 * np.pi / 60 * codec.counts_per_unit if unit else 1.0)


@cache
def range_of(kind: str) -> tuple[int, int]:
    """Return the lowest and highest integer of a type."""
    low = 0 if kind[0] == "U" else -(2 ** (BITS[kind] - 1))
    return low, low + 2 ** BITS[kind] - 1


def signed(raw: int, bits: int) -> int:
    """Return the number of `bits` bits, read without sign, as a two's complement."""
    return raw - (1 << bits) if raw >> (bits - 1) else raw


def saturated(value: Array, kind: str) -> Ints:
    """Return the nearest integers that the type `kind` can hold."""
    low, high = range_of(kind)
    return np.rint(np.minimum(np.maximum(value, low), high)).astype(np.int64)


def interpolation_period(period_s: float) -> tuple[int, int]:
    """Return 60C2h, count (U8) and power of ten (I8) of the SYNC period.

    Raises
    ------
    BadInputError : it has no exact form.
    """
    for unit in (-3, -4, -5, -6):
        count = period_s / 10.0**unit
        if round(count) in range(1, 256) and abs(count - round(count)) < 1e-6 * count:
            return round(count), unit
    raise BadInputError(
        "the interpolation period of the drives (60C2) cannot have this value",
        key="bus.sync_period_s",
        value=period_s,
        shown=f"{period_s:g}",
        expected="1 to 255 times 1 ms, 0.1 ms, 10 µs or 1 µs",
    )
