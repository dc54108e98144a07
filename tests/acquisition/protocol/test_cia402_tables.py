"""CiA 402-2 as tables typed out of the standard: no expectation here goes through
a table of the package.
"""

import itertools

import pytest

from acquisition import protocol
from acquisition.errors import BusFaultError, RobotIdimError
from acquisition.protocol import TRANSITIONS, Command, Mode, State, command_of, state_of, toward

# Statusword 6041h, bits 7 to 0; x: either. The bits 8 to 15 belong to no state. Then what to
# command next on the way up to operation enabled and down to switch on disabled, out of the diagram
# of the standard; "-": the drive goes on by itself.
STATES = """
NOT_READY_TO_SWITCH_ON  x0xx0000  -                 -
SWITCH_ON_DISABLED      x1xx0000  SHUTDOWN          -
READY_TO_SWITCH_ON      x01x0001  SWITCH_ON         DISABLE_VOLTAGE
SWITCHED_ON             x01x0011  ENABLE_OPERATION  DISABLE_VOLTAGE
OPERATION_ENABLED       x01x0111  -                 DISABLE_VOLTAGE
QUICK_STOP_ACTIVE       x00x0111  ENABLE_OPERATION  DISABLE_VOLTAGE
FAULT_REACTION_ACTIVE   x0xx1111  -                 -
FAULT                   x0xx1000  FAULT_RESET       FAULT_RESET
"""
ROWS = [line.split() for line in STATES.strip().splitlines()]
STATUSWORDS = {row[0]: row[1] for row in ROWS}
# Controlword 6040h, bits 7 to 0. "Disable operation" has the bits of "switch on".
CONTROLWORDS = {
    "SHUTDOWN": "0xxxx110", "SWITCH_ON": "0xxx0111", "ENABLE_OPERATION": "0xxx1111",
    "DISABLE_VOLTAGE": "0xxxxx0x",
    "QUICK_STOP": "0xxxx01x", "FAULT_RESET": "1xxxxxxx",
}  # fmt: skip
# Number, from, command, to. 12 is by command here; a drive may also do it by itself, as 605Ah says.
DIAGRAM = """
 2  SWITCH_ON_DISABLED  SHUTDOWN          READY_TO_SWITCH_ON
 3  READY_TO_SWITCH_ON  SWITCH_ON         SWITCHED_ON
 4  SWITCHED_ON         ENABLE_OPERATION  OPERATION_ENABLED
 5  OPERATION_ENABLED   SWITCH_ON         SWITCHED_ON
 6  SWITCHED_ON         SHUTDOWN          READY_TO_SWITCH_ON
 7  READY_TO_SWITCH_ON  QUICK_STOP        SWITCH_ON_DISABLED
 7  READY_TO_SWITCH_ON  DISABLE_VOLTAGE   SWITCH_ON_DISABLED
 8  OPERATION_ENABLED   SHUTDOWN          READY_TO_SWITCH_ON
 9  OPERATION_ENABLED   DISABLE_VOLTAGE   SWITCH_ON_DISABLED
10  SWITCHED_ON         QUICK_STOP        SWITCH_ON_DISABLED
10  SWITCHED_ON         DISABLE_VOLTAGE   SWITCH_ON_DISABLED
11  OPERATION_ENABLED   QUICK_STOP        QUICK_STOP_ACTIVE
12  QUICK_STOP_ACTIVE   DISABLE_VOLTAGE   SWITCH_ON_DISABLED
15  FAULT               FAULT_RESET       SWITCH_ON_DISABLED
16  QUICK_STOP_ACTIVE   ENABLE_OPERATION  OPERATION_ENABLED
"""
COMMANDED = {
    (State[was], Command[command]): State[then]
    for _, was, command, then in (line.split() for line in DIAGRAM.strip().splitlines())
}


def words(pattern: str, bits: int) -> set[int]:
    """All numbers of `bits` bits whose lowest eight are as the pattern says."""
    low = [int("".join(p), 2) for p in itertools.product(*({"x": "01"}.get(c, c) for c in pattern))]
    return {high << 8 | byte for high in range(2 ** (bits - 8)) for byte in low}


def state_or_none(statusword: int) -> State | None:
    try:
        return state_of(statusword)
    except RobotIdimError:
        return None


def test_every_statusword_gives_state():
    expected = {
        word: State[name] for name, pattern in STATUSWORDS.items() for word in words(pattern, 12)
    }
    assert len(expected) == 16 * (8 + 8 + 4 * 4 + 8 + 8)  # no word belongs to two states
    assert len(STATUSWORDS) == len(State) == 8
    for word in range(2**12):
        assert state_or_none(word) is expected.get(word), hex(word)
    for word in (0x1237, 0x0637, 0xF027):
        assert state_of(word) is State.OPERATION_ENABLED
    with pytest.raises(BusFaultError, match="statusword 0x1211 is not a CiA 402 state"):
        state_of(0x1211)


def test_every_controlword_gives_command():
    expected = {
        word: Command[name] for name, pattern in CONTROLWORDS.items() for word in words(pattern, 12)
    }
    assert len(expected) == 2**12  # one command for each, none for two
    for word, command in expected.items():
        assert command_of(word) is command, hex(word)
        assert command_of(word | 0xF000) is command, hex(word)


def test_controlword_of_each_command():
    words = [6, 7, 15, 0, 2, 128]  # in the order of `CONTROLWORDS`
    assert {command.name: command.controlword for command in Command} == dict(
        zip(CONTROLWORDS, words, strict=True)
    )


def test_each_command_in_each_state():
    assert TRANSITIONS == COMMANDED


@pytest.mark.parametrize(
    ("goal", "column"), [(State.OPERATION_ENABLED, 2), (State.SWITCH_ON_DISABLED, 3)]
)
def test_commands_to_enable_and_disable(goal, column):
    commands = {row[0]: toward(State[row[0]], goal) for row in ROWS}
    assert {state: command.name if command else "-" for state, command in commands.items()} == {
        row[0]: row[column] for row in ROWS
    }


def test_no_command_leads_to_fault():
    for goal in (State.FAULT, State.FAULT_REACTION_ACTIVE, State.NOT_READY_TO_SWITCH_ON):
        with pytest.raises(
            BusFaultError, match=f"no command leads from switched on to {goal.words}"
        ):
            toward(State.SWITCHED_ON, goal)
    assert toward(State.FAULT_REACTION_ACTIVE, State.FAULT) is None


def test_states_with_torque_and_operation_modes():
    """Those with the drive function enabled (CiA 402-2, table of the states' functions)."""
    enabled = {State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE}
    assert set(State) - protocol.DISABLED == enabled
    assert [(mode.name, mode.value) for mode in Mode] == [("CYCLIC_SYNCHRONOUS_POSITION", 8)]
