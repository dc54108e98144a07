"""The drive's state machine as axioms over all states; positions there and back. Its tables stand in test_cia402_tables."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.protocol import AUTOMATIC, TRANSITIONS, Command, PositionCodec, State, state_of, toward


def walked(state: State, goal: State) -> list[State]:
    """States passed on the way, each by a legal command or by the drive itself."""
    way = [state]
    while way[-1] is not goal:
        assert len(way) < 8
        command = toward(way[-1], goal)
        way.append(AUTOMATIC[way[-1]] if command is None else TRANSITIONS[way[-1], command])
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


def test_statuswords_of_real_drives():
    assert state_of(0x0250) is State.SWITCH_ON_DISABLED
    assert state_of(0x1237) is State.OPERATION_ENABLED
    assert state_of(0x0637) is State.OPERATION_ENABLED
    assert state_of(0x0238) is State.FAULT


@given(st.integers(-(2**31), 2**31 - 1), st.sampled_from([-1, 1]), st.integers(-10000, 10000))
def test_position_there_and_back(raw, sign, zero):
    codec = PositionCodec(counts_per_unit=4096 / (2 * np.pi), sign=sign, zero_counts=zero)
    assert codec.raw(codec.si(np.array([raw]))).tolist() == [raw]
