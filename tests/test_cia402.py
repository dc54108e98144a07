"""The drive's state machine as axioms over all states, and codecs there and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition import AcquisitionError
from acquisition.cia402 import (
    AUTOMATIC,
    DISABLED,
    EFFORT_OBJECTS,
    RULES,
    TRANSITIONS,
    Command,
    EffortCodec,
    ObjectEntry,
    PositionCodec,
    State,
    after,
    command_of,
    saturated,
    state_of,
    toward,
)


def walked(state: State, goal: State) -> list[State]:
    """States passed on the way, each by a legal command or by the drive itself."""
    way = [state]
    while way[-1] is not goal:
        assert len(way) < 8
        command = toward(way[-1], goal)
        way.append(AUTOMATIC[way[-1]] if command is None else after(way[-1], command))
    return way


@pytest.mark.parametrize("goal", [State.OPERATION_ENABLED, State.SWITCH_ON_DISABLED])
@pytest.mark.parametrize("state", State)
def test_enabled_and_disabled_are_reached_from_every_state(state, goal):
    way = walked(state, goal)
    assert len(set(way)) == len(way)
    if goal is State.SWITCH_ON_DISABLED:
        assert State.OPERATION_ENABLED not in way[1:]


def test_the_way_up_is_shutdown_switch_on_enable():
    way = walked(State.SWITCH_ON_DISABLED, State.OPERATION_ENABLED)
    commands = [toward(state, State.OPERATION_ENABLED) for state in way]
    assert [c and c.controlword for c in commands] == [0x06, 0x07, 0x0F, None]
    assert toward(State.FAULT, State.OPERATION_ENABLED) is Command.FAULT_RESET


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("command", Command)
def test_illegal_transitions_raise(state, command):
    if (state, command) in TRANSITIONS:
        assert after(state, command) is TRANSITIONS[state, command]
    else:
        with pytest.raises(AcquisitionError, match=f"{command.name} in {state.words}: expected"):
            after(state, command)


@given(st.integers(0, 0xFFFF))
def test_a_statusword_tells_one_state_or_none(word):
    telling = [s for s in State if word & s.value[0] == s.value[1]]
    assert len(telling) <= 1
    if telling:
        assert state_of(word) is telling[0]
    else:
        with pytest.raises(AcquisitionError, match=f"statusword 0x{word:04X}"):
            state_of(word)


def test_statuswords_of_real_drives():
    assert state_of(0x0250) is State.SWITCH_ON_DISABLED
    assert state_of(0x1237) is State.OPERATION_ENABLED
    assert state_of(0x0637) is State.OPERATION_ENABLED
    assert state_of(0x0238) is State.FAULT


def test_controlwords_give_their_command():
    for command in Command:
        assert command_of(command.controlword) is command
    assert command_of(0x1F) is Command.ENABLE_OPERATION  # a bit of the mode set
    assert command_of(0x8F) is Command.FAULT_RESET


def test_no_torque_where_disabled():
    assert State.OPERATION_ENABLED not in DISABLED
    assert State.QUICK_STOP_ACTIVE not in DISABLED
    assert {State.SWITCH_ON_DISABLED, State.FAULT, State.SWITCHED_ON} <= DISABLED


@pytest.mark.parametrize(
    ("name", "rated", "raw", "value"),
    [
        ("per mille of rated torque", 0.42, 1000, 0.42),
        ("per mille of rated current", 5.0, -500, -2.5),
        ("per mille of rated force", 80.0, 10, 0.8),
        ("mA", 1.0, 1234, 1.234),
        ("0.01 A", 1.0, 250, 2.5),
        ("mV", 1.0, -10000, -10.0),
        ("mN m", 1.0, 420, 0.42),
        ("uN m", 1.0, 420_000, 0.42),
        ("mN", 1.0, 1500, 1.5),
    ],
)
def test_rules(name, rated, raw, value):
    codec = EffortCodec(
        entry=ObjectEntry(index=0x6074, sub=0, type="I32"), rule=RULES[name], rated=rated, sign=1, provenance=""
    )
    assert codec.si(np.array([raw])) == pytest.approx([value], rel=1e-12)
    assert codec.raw(np.array([value])).tolist() == [raw]


def test_every_known_effort_object_has_a_rule():
    assert all(e.rule in RULES for e in EFFORT_OBJECTS.values())


@given(st.integers(-(2**31), 2**31 - 1), st.sampled_from([-1, 1]), st.integers(-10000, 10000))
def test_position_there_and_back(raw, sign, zero):
    codec = PositionCodec(counts_per_unit=4096 / (2 * np.pi), sign=sign, zero_counts=zero)
    assert codec.raw(codec.si(np.array([raw]))).tolist() == [raw]


def test_a_quarter_turn():
    codec = PositionCodec(counts_per_unit=4096 / (2 * np.pi), sign=-1, zero_counts=100)
    assert codec.si(np.array([100 - 1024])) == pytest.approx([np.pi / 2])


def test_values_too_large_are_held_at_the_ends():
    assert saturated(np.array([1e9, -1e9]), "I16").tolist() == [32767, -32768]
    assert saturated(np.array([300.0, -1.0]), "U8").tolist() == [255, 0]
