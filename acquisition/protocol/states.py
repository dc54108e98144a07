"""States and commands of CiA 402 and their one transition table, without I/O.

Names, bits and transitions are those of CiA 402-2 (IEC 61800-7-201): statusword 6041h, controlword 6040h.
"""

from enum import Enum, IntEnum

from ..errors import AcquisitionError


class State(Enum):
    """A state of the drive and its bits in the statusword: (mask, value)."""

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
        """The name in lower case words."""
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

# Transitions that a drive makes without a command (1 and 14); 13 leads from any state to FAULT_REACTION_ACTIVE.
AUTOMATIC: dict[State, State] = {_S.NOT_READY_TO_SWITCH_ON: _S.SWITCH_ON_DISABLED, _S.FAULT_REACTION_ACTIVE: _S.FAULT}

# No torque in these: the power stage is off, or has nothing to follow.
DISABLED = frozenset(State) - {_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE, _S.FAULT_REACTION_ACTIVE}


def state_of(statusword: int) -> State:
    """State in a statusword (6041h). Raises `AcquisitionError` for bits of no state."""
    for state in State:
        mask, value = state.value
        if statusword & mask == value:
            return state
    raise AcquisitionError(f"statusword 0x{statusword:04X}", expected="the bits of a CiA 402 state")


def command_of(controlword: int) -> Command | None:
    """Command that a controlword (6040h) gives, None where its bits give none."""
    for command in reversed(Command):  # a fault reset before all others
        mask, value = command.value
        if controlword & mask == value:
            return command
    return None


def toward(state: State, goal: State) -> Command | None:
    """First command on the shortest way from `state` to `goal`; None: already there, or the drive needs no command.

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
