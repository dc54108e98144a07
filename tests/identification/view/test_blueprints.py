"""Every Rerun file that a command writes opens: each view of its layout stands under one parent."""

import pytest
from blueprints import has_one_parent_each
from conftest import IDENTIFY, REPLAY

SESSION, ROBOT = REPLAY / "scara" / "session.mcap", REPLAY / "scara" / "robot.toml"
COMMANDS = {  # what stands before --rrd FILE
    "fit": [SESSION],
    "view": [SESSION],
    "view --follow": [SESSION],
    "compare": [REPLAY / "tx40" / "fit.json"] * 2,
    "excite": [ROBOT, "--period", "3", "--harmonics", "3", "--periods", "2", "-o", "ref.csv"],
}


def test_commands_match_writers():
    """That of `demo` is looked at where it is made."""
    commands = next(
        action for action in IDENTIFY.parser(*IDENTIFY.commands)._actions if action.choices
    ).choices
    writing = {
        name for name, parser in commands.items() if "--rrd" in parser._option_string_actions
    }
    assert writing | {"view", "view --follow"} == set(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_each_view_has_one_parent(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out = "-o" if command.startswith("view") else "--rrd"
    assert IDENTIFY.main([*command.split(), *map(str, COMMANDS[command]), out, "a.rrd"]) == 0
    assert has_one_parent_each(tmp_path / "a.rrd")
