"""What the programs print on the shipped robots: lines that fit a terminal, in
words that a user knows.
"""

import re
import shutil

import pytest
from conftest import ACQUIRE, IDENTIFY, REPLAY

from identification.study import simulated_cell

MAX_LINES, MAX_CHARACTERS = 40, 120  # a screen
# Words of the method where plain ones say more.
UNKNOWN_TO_USERS = (
    r"relative gain of joint \S+ missing",
    r"lag of joint joint",
    r"\btests ok\b",
    r"\|(beta - )?true\|",
    r"look at it|read it:",
    r"gives A at the motor: expected",
    r"Newton decrement",
    r"come from the prior",
    r"not_confirmed, ",
    r"bus missing",
    r"move M1 of LS",
    r"\btells?\b|\btold\b|\bknows\b|\bgoes by\b|nobody",
    r"asked for",
)
EVERY = (
    "robot-identify fit log.mcap --json fit.json --report fit.html",
    "robot-identify compare fit.json robot.toml",
    "robot-identify export fit.json --mjcf arm.xml --allow-untrusted",
    "robot-identify validate fit.json log.mcap",
)
SMALL = (
    "robot-identify fit log.mcap --consistent",
    "robot-identify base robot.toml",
    "robot-identify view log.mcap",
    "robot-identify friction log.mcap",
    "robot-identify fleet . -o fleet.parquet",
    "robot-identify excite robot.toml -o out.csv --periods 1 --harmonics 2 --period 3",
    "robot-identify study robot.toml --runs 1 --duration-s 2",
    "robot-identify fit log.mcap --method wls --all",
    "robot-acquire info log.mcap",
    "robot-acquire import log.mcap -o again.mcap",
    "robot-acquire check robot.toml",
    "robot-acquire record robot.toml -o dry.mcap --dry-run --track ref.csv",
    "robot-identify demo --robot scara --out demo",
)


@pytest.mark.parametrize(
    ("name", "commands"), [("scara", EVERY + SMALL), ("tx40", EVERY[:2]), ("emps", EVERY)]
)
def test_lines_fit_terminal_and_use_user_words(name, commands, tmp_path, monkeypatch, capsys):
    for file, source in (("log.mcap", "session.mcap"), ("robot.toml", "robot.toml")):
        shutil.copy(REPLAY / name / source, tmp_path / file)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulated_cell, "SESSION_S", 2.0)
    (tmp_path / "ref.csv").write_text("time_s,shoulder,elbow\n0,0,0\n0.3,0,0\n")
    for command in commands:
        program, *arguments = command.split()
        {"robot-identify": IDENTIFY, "robot-acquire": ACQUIRE}[program].main(arguments)
        printed = capsys.readouterr()
        lines = [*printed.out.splitlines(), *printed.err.splitlines()]
        assert lines, command
        if "--all" not in arguments:
            assert len(printed.out.splitlines()) <= MAX_LINES, command
        if "--all" not in arguments and "info" not in arguments:  # in a pipe these have whole lines
            assert [
                line for line in lines if len(line) > MAX_CHARACTERS and "─" not in line
            ] == [], command
        for words in UNKNOWN_TO_USERS:
            assert not [line for line in lines if re.search(words, line)], (command, words)
