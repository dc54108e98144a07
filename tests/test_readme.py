"""The README's commands: each is one the programs take, and those that need no hardware run as they stand."""

import re
import shlex
import shutil

import pytest
from conftest import REPLAY, ROOT

from acquisition.commands.program import PROGRAM as ACQUIRE
from identification.commands.program import PROGRAM as IDENTIFY

README = (ROOT / "README.md").read_text()
BLOCK = re.findall(r"^ {4,}(robot-(?:acquire|identify) .*)$", README, flags=re.MULTILINE)
INLINE = re.findall(r"`(robot-(?:acquire|identify) [a-z]+ [^`]*)`", README)
COMMANDS = list(dict.fromkeys(line.split("#")[0].strip() for line in BLOCK + INLINE))


def test_the_readme_has_commands():
    assert len(COMMANDS) >= 15
    programs = {command.split()[0] for command in COMMANDS}
    assert programs == {"robot-acquire", "robot-identify"}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_one_the_program_takes(command):
    program, *arguments = shlex.split(command)
    parser = (ACQUIRE if program == ACQUIRE.name else IDENTIFY).parser()
    if len(arguments) > 1:
        assert callable(parser.parse_args(arguments).run)


def test_commands_without_hardware_run_as_they_stand(tmp_path, monkeypatch, capsys):
    shutil.copy(REPLAY / "tx40" / "session.mcap", tmp_path / "log.mcap")
    shutil.copy(REPLAY / "tx40" / "session.mcap", tmp_path / "other.mcap")
    shutil.copy(REPLAY / "tx40" / "robot.toml", tmp_path / "robot.toml")
    shutil.copy(REPLAY / "tx40" / "robot.toml", tmp_path / "corrected.toml")
    monkeypatch.chdir(tmp_path)
    ran = 0
    for command in COMMANDS:
        program, *arguments = shlex.split(command)
        runs = {"base", "info", "fit", "validate", "decode", "export", "view", "compare"}
        if arguments[0] not in runs or any("replay_data" in a or "MCAP" in a.upper()[:4] for a in arguments):
            continue
        if len(arguments) < 2 or not all((tmp_path / a).exists() for a in arguments[1:2] if not a.startswith("-")):
            continue
        assert (ACQUIRE if program == ACQUIRE.name else IDENTIFY).main(arguments) == 0, command
        ran += 1
    assert ran >= 5
    capsys.readouterr()


def test_the_two_commands_that_set_everything_up_are_there():
    assert "pip install -e . && .venv/bin/robot-identify demo" in README
    assert "pip install -c .constraints.txt -e '.[test]' && .venv/bin/pytest" in README


def test_every_key_of_a_description_is_explained():
    from msgspec.structs import fields

    from acquisition.robot import bus as bus_description
    from acquisition.robot import description

    tables = (description.Joint, description.Motor, description.Controller, description.Identification, description.DH)
    tables += (bus_description.BusFile, bus_description.DriveFile)
    named = set(re.findall(r"[a-z][a-z0-9_]*", README))
    for table in tables:
        for field in fields(table):
            assert field.name in named, f"{table.__name__}.{field.name} is not in the README"


def test_every_option_of_identify_is_named():
    parser = IDENTIFY.parser()
    commands = next(action for action in parser._actions if action.choices)
    for name, command in commands.choices.items():
        for action in command._actions:
            longest = max(action.option_strings, key=len, default="--help")
            assert longest == "--help" or re.search(rf"{longest}\b|`{action.option_strings[0]} ", README), (
                f"{name} {longest}"
            )


def test_every_picture_is_shown():
    pictures = {path.name for path in (REPLAY / "pictures").iterdir()}
    assert set(re.findall(r"!\[[^]]*\]\(replay_data/pictures/([^)]*)\)", README)) == pictures
