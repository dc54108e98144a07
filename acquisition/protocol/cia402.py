"""The drive protocol without I/O: states and their one transition table, and objects between raw integers and SI.

Names, bits and transitions are those of CiA 402-2 (IEC 61800-7-201): statusword 6041h, controlword 6040h.
"""

from dataclasses import dataclass
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from ..errors import AcquisitionError

Vector = NDArray[np.float64]


class State(Enum):
    """A state of the drive and the bits of the statusword that tell it: (mask, value)."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @property
    def words(self) -> str:
        """The name as people write it."""
        return self.name.lower().replace("_", " ")


class Command(Enum):
    """A command of the controlword: (mask, value). From operation enabled, SWITCH_ON is "disable operation"."""

    SHUTDOWN = (0x87, 0x06)
    SWITCH_ON = (0x8F, 0x07)
    ENABLE_OPERATION = (0x8F, 0x0F)
    DISABLE_VOLTAGE = (0x82, 0x00)
    QUICK_STOP = (0x86, 0x02)
    FAULT_RESET = (0x80, 0x80)  # acts on the rising edge

    @property
    def controlword(self) -> int:
        """What to write to 6040h."""
        return self.value[1]


class Mode(IntEnum):
    """Modes of operation, 6060h and 6061h."""

    CYCLIC_SYNCHRONOUS_POSITION = 8
    CYCLIC_SYNCHRONOUS_TORQUE = 10


_S, _C = State, Command
# Where a command leads (transitions 2 to 12, 15, 16). A command that is not here is illegal in that state.
TRANSITIONS: dict[tuple[State, Command], State] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.FAULT, _C.FAULT_RESET): _S.SWITCH_ON_DISABLED,  # 15
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16
}
# What a drive does by itself (transitions 1 and 14); 13 leads from anywhere to FAULT_REACTION_ACTIVE.
AUTOMATIC: dict[State, State] = {
    _S.NOT_READY_TO_SWITCH_ON: _S.SWITCH_ON_DISABLED,
    _S.FAULT_REACTION_ACTIVE: _S.FAULT,
}
# No torque in these: the power stage is off, or has nothing to follow.
DISABLED = frozenset(State) - {_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE, _S.FAULT_REACTION_ACTIVE}


def state_of(statusword: int) -> State:
    """State that a statusword (6041h) tells. Raises `AcquisitionError` for bits that tell none."""
    for state in State:
        mask, value = state.value
        if statusword & mask == value:
            return state
    raise AcquisitionError(f"statusword 0x{statusword:04X}: expected the bits of a CiA 402 state")


def command_of(controlword: int) -> Command | None:
    """Command that a controlword (6040h) gives, None where its bits give none."""
    for command in reversed(Command):  # a fault reset before all others
        mask, value = command.value
        if controlword & mask == value:
            return command
    return None


def after(state: State, command: Command) -> State:
    """State that `command` leads to. Raises `AcquisitionError` for a transition CiA 402 does not have."""
    try:
        return TRANSITIONS[state, command]
    except KeyError:
        legal = [c.name for s, c in TRANSITIONS if s is state]
        expected = f"one of {', '.join(legal)}" if legal else "no command: the drive goes on by itself"
        raise AcquisitionError(f"{command.name} in {state.words}: expected {expected}") from None


def toward(state: State, goal: State) -> Command | None:
    """First command on the shortest way from `state` to `goal`; None: there already, or the drive goes on by itself.

    Raises `AcquisitionError` when no way leads there.
    """
    reached: dict[State, Command | None] = {state: None}
    queue = [state]
    for at in queue:
        if at is goal:
            return reached[at]
        steps: list[tuple[Command | None, State]] = [(c, s) for (was, c), s in TRANSITIONS.items() if was is at]
        if at in AUTOMATIC:
            steps.append((None, AUTOMATIC[at]))
        for command, then in steps:
            if then not in reached:
                reached[then] = command if at is state else reached[at]
                queue.append(then)
    raise AcquisitionError(f"from {state.words} no command leads to {goal.words}")


# Integer types of object dictionaries by their number in CiA 301: name, numpy dtype.
INTEGERS = {
    2: ("I8", "<i1"),
    3: ("I16", "<i2"),
    4: ("I32", "<i4"),
    5: ("U8", "<u1"),
    6: ("U16", "<u2"),
    7: ("U32", "<u4"),
}
BITS = {name: 8 * int(dtype[-1]) for name, dtype in INTEGERS.values()}


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
    def mapping(self) -> int:
        """The entry as a PDO mapping parameter names it: index, sub-index, bits."""
        return self.index << 16 | self.sub << 8 | self.bits

    def __str__(self) -> str:
        return f"{self.index:04X}:{self.sub}"


CONTROLWORD, STATUSWORD = 0x6040, 0x6041
MODE_OF_OPERATION, MODE_DISPLAY = 0x6060, 0x6061
CONSUMER_HEARTBEAT, HEARTBEAT_TIME = 0x1016, 0x1017  # of CiA 301
ABORT_CONNECTION = (
    0x6007  # what a drive does when it loses the master: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop
)
STOP_OPTIONS = QUICK_STOP_OPTION, SHUTDOWN_OPTION, DISABLE_OPTION, FAULT_OPTION = 0x605A, 0x605B, 0x605C, 0x605E
FOLLOWING_ERROR_WINDOW, FOLLOWING_ERROR_TIME, QUICK_STOP_DECELERATION = 0x6065, 0x6066, 0x6085
POSITION_ACTUAL, TARGET_POSITION = 0x6064, 0x607A
RATED_CURRENT, RATED_TORQUE = 0x6075, 0x6076
# Entries whose type CiA 402 (or 301) fixes.
STANDARD = {
    (index, 0): kind
    for kind, indices in {
        "U16": (CONTROLWORD, STATUSWORD, HEARTBEAT_TIME, FOLLOWING_ERROR_TIME),
        "I8": (MODE_OF_OPERATION, MODE_DISPLAY),
        "I32": (0x6062, 0x6063, POSITION_ACTUAL, 0x606C, TARGET_POSITION, 0x60F4, 0x60FC),
        "I16": (ABORT_CONNECTION, *STOP_OPTIONS, 0x6071, 0x6074, 0x6077, 0x6078, 0x60B2),
        "U32": (FOLLOWING_ERROR_WINDOW, RATED_CURRENT, RATED_TORQUE, QUICK_STOP_DECELERATION),
    }.items()
    for index in indices
} | {(0x60C2, 1): "U8", (0x60C2, 2): "I8", (0x608F, 1): "U32", (0x608F, 2): "U32"}


@dataclass(frozen=True, kw_only=True)
class Rule:
    """How a raw integer becomes amperes, volts, newton metres or newtons: value = raw · factor · rated.

    `rated` is the key of the rated value it multiplies, empty where there is none.
    """

    name: str
    unit: str
    factor: float
    rated: str = ""


RULES = {
    rule.name: rule
    for rule in (
        Rule(name="per mille of rated torque", unit="N m", factor=1e-3, rated="rated_torque_nm"),
        Rule(name="per mille of rated current", unit="A", factor=1e-3, rated="rated_current_a"),
        Rule(name="per mille of rated force", unit="N", factor=1e-3, rated="rated_force_n"),
        Rule(name="mA", unit="A", factor=1e-3),
        Rule(name="0.01 A", unit="A", factor=1e-2),
        Rule(name="mV", unit="V", factor=1e-3),
        Rule(name="mN m", unit="N m", factor=1e-3),
        Rule(name="uN m", unit="N m", factor=1e-6),
        Rule(name="mN", unit="N", factor=1e-3),
    )
}


@dataclass(frozen=True, kw_only=True)
class EffortObject:
    """An object that holds a current or a torque, and the rule its vendor documents."""

    entry: ObjectEntry
    rule: str
    meaning: str


EFFORT_OBJECTS = {
    (e.entry.index, e.entry.sub): e
    for e in (
        EffortObject(
            entry=ObjectEntry(index=0x6074, sub=0, type="I16"),
            rule="per mille of rated torque",
            meaning="torque demand, the reference of the current loop (CiA 402)",
        ),
        EffortObject(
            entry=ObjectEntry(index=0x6077, sub=0, type="I16"),
            rule="per mille of rated torque",
            meaning="torque actual value (CiA 402)",
        ),
        EffortObject(
            entry=ObjectEntry(index=0x6078, sub=0, type="I16"),
            rule="per mille of rated current",
            meaning="current actual value (CiA 402)",
        ),
        EffortObject(
            entry=ObjectEntry(index=0x30D0, sub=0, type="I32"), rule="mA", meaning="current demand value (maxon EPOS4)"
        ),
        EffortObject(
            entry=ObjectEntry(index=0x2031, sub=0, type="I16"), rule="mA", meaning="current demand value (maxon EPOS2)"
        ),
        EffortObject(
            entry=ObjectEntry(index=0x221E, sub=0, type="I16"), rule="0.01 A", meaning="commanded current (Copley)"
        ),
    )
}
# Units in which drives state their rated values; 6076h is mN m by CiA 402, and uN m in an EPOS4.
RATED_UNITS = {"mA": 1e-3, "mN m": 1e-3, "uN m": 1e-6, "mN": 1e-3}


@dataclass(frozen=True, kw_only=True)
class EffortCodec:
    """Between the raw integers of `entry` and SI at the motor; `provenance` tells where the value comes from."""

    entry: ObjectEntry
    rule: Rule
    rated: float
    sign: int
    provenance: str

    @property
    def scale(self) -> float:
        """SI per raw unit, sign included."""
        return self.sign * self.rule.factor * self.rated

    def si(self, raw: NDArray[np.int64]) -> Vector:
        """A, V, N m or N, of any shape."""
        return np.asarray(raw * self.scale, dtype=np.float64)

    def raw(self, value: Vector) -> NDArray[np.int64]:
        """Nearest raw integers, held at the ends of the object's type as a drive does."""
        return saturated(value / self.scale, self.entry.type)


@dataclass(frozen=True, kw_only=True)
class PositionCodec:
    """Between counts and rad (or m) of the motor: counts = zero_counts + sign · counts_per_unit · position.

    Of one motor, or of n with a vector in each field.
    """

    counts_per_unit: float | Vector
    sign: int | Vector
    zero_counts: int | Vector

    def si(self, raw: NDArray[np.int64]) -> Vector:
        """Motor position in rad or m, of any shape."""
        return np.asarray((raw - self.zero_counts) * (self.sign / self.counts_per_unit), dtype=np.float64)

    def exact(self, value: Vector) -> Vector:
        """Counts before they are rounded and held."""
        return np.asarray(value * (self.sign * self.counts_per_unit) + self.zero_counts, dtype=np.float64)

    def raw(self, value: Vector) -> NDArray[np.int64]:
        """Nearest counts, held at the ends of 32 bits."""
        return saturated(self.exact(value), "I32")


def saturated(value: Vector, kind: str) -> NDArray[np.int64]:
    """Nearest integers that the type `kind` can hold."""
    low, high = (0, 2 ** BITS[kind] - 1) if kind[0] == "U" else (-(2 ** (BITS[kind] - 1)), 2 ** (BITS[kind] - 1) - 1)
    return np.rint(np.clip(value, low, high)).astype(np.int64)
