"""The generated reference is that of the code; each key and option has a description, a number its unit."""

import re

import pytest
from key_reference import ACQUIRE, BUS_TABLES, IDENTIFY, MAP_TABLES, ROBOT_TABLES, keys_of, options_of, pages

from acquisition.importing.tables import TableMap
from acquisition.robot import RobotFile

# By the last part of a key its unit, as a word of the description.
UNITS = {
    "deg": "deg",
    "m": "m",
    "s": "s",
    "s2": r"(deg|m)/s²",
    "hz": "Hz",
    "nm": "N m",
    "n": "N",
    "kg": "kg",
    "a": "A",
    "percent": "%",
    "samples": "samples",
    "periods": "periods",
    "counts": "counts",
}
# Numbers of which the key does not name the unit.
OTHERS = {
    "station": "EtherCAT station address",
    "gravity_m_s2": "m/s²",
    "speed_deg_s": "deg/s",
    "speed_m_s": "m/s",
    "stribeck_speed_deg_s": "deg/s",
    "stribeck_speed_m_s": "m/s",
    "counts_per_turn": "counts per motor revolution",
    "counts_per_m": "counts per metre",
    "ratio": "per joint rad",
    "drive_gain": "drive_gain_unit",
    "drive_gain_half_width": "same unit",
    "saturation": "recorded unit",
    "position_gain": "1/s²",
    "velocity_gain": "1/s",
    "integral_gain": "effort per rad s",
    "motor_matrix": "motor speed",
    "ls": "%",
    "iv": "%",
    "decimation": "samples per row",
    "max_iterations": "passes",
    "scale": "unit per raw integer",
    "sign": "-1",
    "effort_sign": "-1",
    "bitrate": "bit/s",
    "node": "node id",
    "master_node": "node id",
    "other_nodes": "node ids",
    "can_id": "identifier",
    "sync_can_id": "identifier",
    "number": "number of the PDO",
    "parameters": "SI",
    "column": "by name or number",
    "columns": "by name or number",
    "ticks": "counter",
    "table": "file",
}
KEYS = [
    pytest.param(key, found, id=f"{table}.{key}")
    for kind in (RobotFile, TableMap)
    for table, keys in keys_of(kind).items()
    for key, found in keys.items()
]


@pytest.mark.parametrize("path", pages(), ids=lambda path: path.parent.name)
def test_the_reference_is_that_of_the_code(path):
    assert path.read_text() == pages()[path], "run `python tests/key_reference.py`"


def test_the_reference_has_all_tables():
    assert {*ROBOT_TABLES, *BUS_TABLES} == set(keys_of(RobotFile))
    assert set(MAP_TABLES) == set(keys_of(TableMap))


def has_numbers(found):
    return bool({"number", "integer"} & set(re.findall(r"'type': '(\w+)'", str(found))))


@pytest.mark.parametrize(("key", "found"), KEYS)
def test_a_key_has_a_description_and_a_number_its_unit(key, found):
    assert found.get("description")
    if has_numbers(found):
        unit = OTHERS.get(key) or UNITS[key.rsplit("_", 1)[-1]]
        assert re.search(rf"(?<!\w){unit}(?![\w/])", found["description"]), unit


@pytest.mark.parametrize("program", [ACQUIRE, IDENTIFY], ids=lambda program: program.name)
def test_an_option_has_a_description(program):
    found = list(options_of(program))
    assert len(found) > 30
    assert [f"{command} {action.dest}" for command, action in found if not action.help] == []


def test_commands_and_options_stay_few():
    """Long options are counted once for each command that has them."""
    found = [action for program in (ACQUIRE, IDENTIFY) for _, action in options_of(program)]
    assert len([*ACQUIRE.commands, *IDENTIFY.commands]) <= 24
    assert sum(any(name.startswith("--") for name in action.option_strings) for action in found) <= 144
