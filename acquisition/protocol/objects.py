"""Objects of CiA 301 and CiA 402: indices, types, codecs between raw integers and SI."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from ..arrays import Array, Ints
from ..errors import BadInputError

# Data types by their number in CiA 301.
INTEGERS = {2: "I8", 3: "I16", 4: "I32", 5: "U8", 6: "U16", 7: "U32"}
BITS = {kind: int(kind[1:]) for kind in INTEGERS.values()}


@dataclass(frozen=True, kw_only=True)
class ObjectEntry:
    """An entry of the object dictionary: index, sub-index, and type (I8 to U32)."""

    index: int
    sub: int
    type: str

    @property
    def bits(self) -> int:
        """Size in a PDO, bits."""
        return BITS[self.type]

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.sub

    @property
    def mapping(self) -> int:
        """Value in a PDO mapping parameter: index, sub-index, bits."""
        return self.index << 16 | self.sub << 8 | self.bits

    def __str__(self) -> str:
        return f"{self.index:04X}:{self.sub}"


EMERGENCY, HEARTBEAT = 0x80, 0x700  # CAN identifiers of CiA 301, plus the node id
CONTROLWORD, STATUSWORD = 0x6040, 0x6041
MODE_OF_OPERATION, MODE_DISPLAY = 0x6060, 0x6061
DEVICE_TYPE, CONSUMER_HEARTBEAT, HEARTBEAT_TIME = 0x1000, 0x1016, 0x1017  # of CiA 301
TEXTS = 0x1008, 0x1009, 0x100A  # device name, hardware version, software version
# Reaction of a drive that loses the master: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop.
ABORT_CONNECTION = 0x6007
STOP_OPTIONS = QUICK_STOP_OPTION, SHUTDOWN_OPTION, DISABLE_OPTION, FAULT_OPTION = (
    0x605A,
    0x605B,
    0x605C,
    0x605E,
)
FOLLOWING_ERROR_WINDOW, FOLLOWING_ERROR_TIME = 0x6065, 0x6066
PROFILE_DECELERATION, QUICK_STOP_DECELERATION = 0x6084, 0x6085
# Objects with the deceleration of a quick stop, by the value of 605Ah. With 5 or 6 the drive stays
# in quick stop active.
_RAMPS = {
    1: PROFILE_DECELERATION,
    2: QUICK_STOP_DECELERATION,
    5: PROFILE_DECELERATION,
    6: QUICK_STOP_DECELERATION,
}
VELOCITY_UNIT, _ACCELERATION_UNIT = 0x60A9, 0x60AA
# Drives of maxon and Nanotec encode these units in this way.
RPM, _RPM_PER_S = 0x00B44700, 0x00C00300
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
# Encoder, gear and feed are ratios, of sub-index 1 to sub-index 2.
POSITION_UNITS = _, GEAR, _ = 0x608F, 0x6091, 0x6092
HOME_OFFSET, INTERPOLATION_PERIOD = 0x607C, 0x60C2
SUPPORTED_MODES = 0x6502

# CiA 402 (or 301) defines the types of these entries.
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
} | {
    (INTERPOLATION_PERIOD, 1): "U8",
    (INTERPOLATION_PERIOD, 2): "I8",
    (POSITION_LIMITS, 1): "I32",
    (POSITION_LIMITS, 2): "I32",
    **{(index, sub): "U32" for index in POSITION_UNITS for sub in (1, 2)},
}
# These types are defined as well, but simulated drives without a dictionary do not need them.
_MORE_TYPES = {
    (0x1029, 1): "U8",
    (0x1015, 0): "U16",
    (0x603F, 0): "U16",
    **{(index, 0): "U32" for index in (0x1002, 0x1005, 0x1006, 0x1007, 0x1014, *TEXTS)},
}


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Conversion of a raw integer to A, V, N m or N.

        value = raw · factor · rated

    Attributes:
        unit: unit of the result.
        factor: factor of the raw integer.
        rated: key in robot.toml of the rated value of the drive; empty for 1.
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

# Objects with a current or a torque: type, rule of the manufacturer's manual, meaning.
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

# Units of the rated values in drives. By CiA 402, 6076h is in mN m, but an EPOS4 uses uN m.
RATED_UNITS = {"mA": 1e-3, "mN m": 1e-3, "uN m": 1e-6, "mN": 1e-3}


@dataclass(frozen=True, kw_only=True)
class EffortCodec:
    """Conversion between raw integers and an effort at the motor.

    Attributes:
        entry: object with the effort.
        scale: A, V, N m or N per raw unit.
        provenance: source of the value, as text.
    """

    entry: ObjectEntry
    scale: float
    provenance: str

    def si(self, raw: Ints) -> Array:
        """Convert raw integers of any shape to A, V, N m or N."""
        return np.asarray(raw * self.scale, dtype=np.float64)

    def raw(self, value: Array) -> Ints:
        """Convert efforts to the nearest raw integers.

        They are limited to the range of the type, as in a drive.
        """
        return saturated(value / self.scale, self.entry.type)


@dataclass(frozen=True, kw_only=True)
class PositionCodec:
    """Conversion between counts and motor positions, of one motor or of n.

        counts = zero_counts + sign · counts_per_unit · position

    Attributes:
        counts_per_unit: counts per rad, or per m.
        sign: 1 or -1.
        zero_counts: counts at position 0.
    """

    counts_per_unit: float | Array
    sign: int | Array
    zero_counts: int | Array

    def si(self, raw: Ints) -> Array:
        """Convert counts of any shape to positions in rad or m."""
        return np.asarray(
            (raw - self.zero_counts) * (self.sign / self.counts_per_unit), dtype=np.float64
        )

    def exact(self, value: Array) -> Array:
        """Convert positions in rad or m to counts, without rounding and limits."""
        return np.asarray(
            value * (self.sign * self.counts_per_unit) + self.zero_counts, dtype=np.float64
        )

    def raw(self, value: Array) -> Ints:
        """Convert positions in rad or m to the nearest counts, limited to 32 bits."""
        return saturated(self.exact(value), "I32")


def object_type(index: int, sub: int) -> str:
    """Return the type of an object, of any axis.

    The type of an object that is not listed here is U8 for the count of a record of CiA 301, and
    U32 for all others.
    """
    # These are the communication parameters of PDOs.
    if index & 0xFE00 in (0x1400, 0x1800):
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
    """Return the size of an object by its `object_type`, bytes."""
    return BITS[object_type(index, sub)] // 8


def position_units_per_turn(values: Mapping[tuple[int, int], int | None]) -> float | None:
    """Return the position units per motor turn from the values of 6092h, 6091h and 608Fh.

    They are the feed (6092h) divided by the gear (6091h, or 1). Without a feed they are given by
    608Fh. The result is None if they are unknown.
    """
    encoder, gear, feed = (
        (values.get((i, 1)) or 0) / (values.get((i, 2)) or np.inf) for i in POSITION_UNITS
    )
    return (feed / (gear or 1.0) if feed else encoder) or None


def quick_stop_ramp(values: Mapping[int, int | None], codec: PositionCodec) -> float | None:
    """Return the quick stop deceleration that 605Ah selects, counts/s² of the motor.

    Its unit is that of the position, unless 60AAh or 60A9h gives rpm/s or rpm.

    Parameters
    ----------
    values : raw values of `RAMP_OBJECTS`.
    codec : codec of the position.

    Returns
    -------
    The deceleration; None if it is unknown.
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
    """Convert an unsigned number of `bits` bits to a signed one (two's complement)."""
    return raw - (1 << bits) if raw >> (bits - 1) else raw


def saturated(value: Array, kind: str) -> Ints:
    """Return the nearest integers that the type `kind` can represent."""
    low, high = range_of(kind)
    return np.rint(np.minimum(np.maximum(value, low), high)).astype(np.int64)


def interpolation_period(period_s: float) -> tuple[int, int]:
    """Return count (U8) and power of ten (I8) of the SYNC period, for 60C2h.

    Raises
    ------
    BadInputError : 60C2h cannot represent the period exactly.
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
