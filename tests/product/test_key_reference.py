"""The generated reference is that of the code; each key and option has a description."""

import pytest
from key_reference import (
    ACQUIRE,
    BUS_TABLES,
    IDENTIFY,
    MAP_TABLES,
    ROBOT_TABLES,
    keys_of,
    options_of,
    pages,
)

from acquisition.importing import TableMap
from acquisition.robot import RobotFile


@pytest.mark.parametrize("path", pages(), ids=lambda path: "/".join(path.parts[-3:]))
def test_reference_matches_code(path):
    assert path.read_text() == pages()[path], "run `python tests/key_reference.py`"


def test_reference_has_all_tables():
    assert {*ROBOT_TABLES, *BUS_TABLES} == set(keys_of(RobotFile))
    assert set(MAP_TABLES) == set(keys_of(TableMap))


@pytest.mark.parametrize("program", [ACQUIRE, IDENTIFY], ids=lambda program: program.name)
def test_options_have_descriptions(program):
    found = list(options_of(program))
    assert len(found) > 30
    assert [f"{command} {action.dest}" for command, action in found if not action.help] == []


def test_commands_and_options_stay_few():
    """Long options are counted once for each command that has them."""
    found = [action for program in (ACQUIRE, IDENTIFY) for _, action in options_of(program)]
    assert len(ACQUIRE.commands) == 7
    assert len([*ACQUIRE.commands, *IDENTIFY.commands]) == 20
    assert (
        sum(any(name.startswith("--") for name in action.option_strings) for action in found) <= 155
    )
