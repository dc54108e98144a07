"""What the programs print on the shipped robots: lines that fit a terminal, in words that a user knows."""

import re
import shutil

import pytest
from conftest import PROGRAMS, REPLAY

from acquisition.robot import load_robot

MAX_CHARACTERS = 120
# Words of the method where plain ones say more.
UNKNOWN_TO_USERS = (
    r"essentials to ",
    r"relative gain of joint \S+ missing",
    r"lag of joint joint",
    r"do(es)? not explain the regressor",
    r"possibly by chance",
    r"sampled at one phase",
    r"\btests ok\b",
    r"off by, ",
    r"in their 95 % interval",
    r"\|beta - true\|",
    r"largest of \d+ essential",
    r"look at it|read it:",
    r"gives A at the motor: expected",
    r"a table needs --map",
    r"interface\? try",
    r"Newton decrement",
    r"come from the prior",
    r"not_confirmed, ",
    r"not possible by chance|\d+ not made",
    r"\|true\|",
    r"move both by less",
    r"wider than the value; \d+ left out",
    r"bus missing",
    r"move M1 of LS",
    r"does not determine parameters that",
    r"\btells?\b|\btold\b|\bknows\b|\bgoes by\b|nobody",
    r"asked for",
    r"cannot be told",
    r"begins with b",
)
COMMANDS = {
    "fit": "robot-identify fit log.mcap --json fit.json --report fit.html",
    "consistent": "robot-identify fit log.mcap --consistent",
    "wls": "robot-identify fit log.mcap --method wls",
    "everything": "robot-identify fit log.mcap --all",
    "compare": "robot-identify compare fit.json robot.toml",
    "export": "robot-identify export fit.json --mjcf arm.xml --allow-untrusted",
    "info": "robot-acquire info log.mcap",
    "import": "robot-acquire import log.mcap -o again.mcap",
    "validate": "robot-identify validate fit.json log.mcap",
    "check": "robot-acquire check robot.toml",
    "dry run": "robot-acquire record robot.toml -o dry.mcap --dry-run --track ref.csv",
    "demo": "robot-identify demo --robot scara --out demo",
}


@pytest.mark.parametrize("name", ["scara", "tx40", "emps"])
def test_every_line_fits_a_terminal_and_is_in_words_of_users(name, tmp_path, monkeypatch, capsys):
    for file, source in (("log.mcap", "session.mcap"), ("robot.toml", "robot.toml")):
        shutil.copy(REPLAY / name / source, tmp_path / file)
    monkeypatch.chdir(tmp_path)
    joints = [joint.name for joint in load_robot(tmp_path / "robot.toml").joints]
    (tmp_path / "ref.csv").write_text(f"time_s,{','.join(joints)}\n0{',0' * len(joints)}\n0.3{',0' * len(joints)}\n")
    for what, command in COMMANDS.items():
        many = ("demo", "consistent", "wls")  # of the small robot alone
        if (what in many and name != "scara") or (what in ("check", "dry run") and name == "emps"):
            continue
        program, *arguments = command.split()
        {"robot-identify": PROGRAMS["identification"], "robot-acquire": PROGRAMS["acquisition"]}[program].main(
            arguments
        )
        printed = capsys.readouterr()
        lines = [*printed.out.splitlines(), *printed.err.splitlines()]
        assert lines, command
        if what not in ("everything", "info"):  # in a pipe these have whole lines
            assert [line for line in lines if len(line) > MAX_CHARACTERS and "─" not in line] == [], command
        for words in UNKNOWN_TO_USERS:
            assert not [line for line in lines if re.search(words, line)], (command, words)
