"""What stands at the name of an output: only a file of the output's kind is replaced."""

from pathlib import Path

import pytest
from conftest import ACQUIRE, IDENTIFY, REPLAY

from acquisition.errors import BadInputError
from acquisition.files import kind_of
from identification import load, read_robot
from identification.report import write_json

SCARA, SESSION, AXIS = (
    REPLAY / path for path in ("scara/robot.toml", "scara/session.mcap", "emps/session.mcap")
)
FIT, FITS = REPLAY / "scara" / "fit.json", REPLAY / "tx40" / "fit.json"
# Programs with a command, and its options that name an output.
OUTPUTS = [
    (IDENTIFY, f"fit {SESSION}", "--json --rrd --report"),
    (IDENTIFY, f"validate {FIT} {SESSION}", "--json --report"),
    (IDENTIFY, f"compare {FIT} {FIT}", "--json --report"),
    (IDENTIFY, f"export {FIT}", "--urdf --mjcf --toml"),
    (IDENTIFY, f"base {SCARA}", "--json"),
    (IDENTIFY, f"init {REPLAY / 'scara' / 'arm.urdf'} --overwrite", "-o"),
    (IDENTIFY, f"simulate {SCARA} --overwrite", "-o"),
    (IDENTIFY, f"excite {SCARA} -o made.csv", "-o --rrd --report"),
    (IDENTIFY, f"friction {SESSION}", "--json --report"),
    (IDENTIFY, f"study {SCARA}", "--json --report"),
    (IDENTIFY, f"study {SESSION}", "--report"),
    (IDENTIFY, f"fleet {REPLAY / 'scara'}", "-o"),
    (IDENTIFY, f"view {SESSION}", "-o"),
    (ACQUIRE, f"info {SESSION}", "--csv"),
    (ACQUIRE, f"import {SESSION} --overwrite", "-o"),
]
ENDINGS = {"--report": [".md", ".html"], "fleet": [".csv", ".parquet"], "view": [".rrd", ".html"]}
# What a user may have there, whatever the ending of its name says.
OTHERS = {
    "a description": SCARA.read_bytes(),
    "notes": b"check the brake of joint 3\n",
    "foreign JSON": b'{"name": "my-cell", "private": true}\n',
    "a drawing": b'<?xml version="1.0"?>\n<!-- a -->\n<svg/>\n',
    "a xacro": b'<robot name="arm" xmlns:xacro="http://ros.org/wiki/xacro"/>',
    "a script": b"import os, sys\n",
}


@pytest.mark.parametrize(("program", "command", "options"), OUTPUTS, ids=lambda x: str(x)[:8])
def test_output_keeps_file_of_other_kind(program, command, options, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for option in options.split():
        endings = ENDINGS.get(option, ENDINGS.get(command.split()[0], [".txt"]))
        kept = {k: x for k, x in OTHERS.items() if k != "a description" or "init" not in command}
        for ending, (name, content) in ((e, own) for e in endings for own in kept.items()):
            if (option, name) == ("--toml", "a description"):
                continue  # its kind
            there = Path(f"there{ending}")
            there.write_bytes(content)
            assert program.main([*command.split(), option, str(there)]) == 1
            printed, said = capsys.readouterr()
            assert (printed, said.count("\n")) == ("", 1)  # before any work
            assert f": {there}: the file already exists and is a " in said, name
            assert there.read_bytes() == content
            assert [path.name for path in tmp_path.iterdir()] == [there.name]
            there.unlink()


@pytest.mark.parametrize(
    ("program", "command"),
    [
        (IDENTIFY, f"base {SCARA} --json out"),
        (IDENTIFY, f"compare {FIT} {FIT} --report out.md --json out"),
        (IDENTIFY, f"compare {FIT} {FIT} --report out.html"),
        (IDENTIFY, f"export {FITS} --urdf out --mjcf out.xml --toml out.txt"),
        (IDENTIFY, f"simulate {SCARA} -o out --duration-s 1 --overwrite"),
        (IDENTIFY, f"view {SESSION} -o out"),
        (IDENTIFY, f"friction {AXIS} --report out.md"),
        (ACQUIRE, f"info {SESSION} --csv out"),
    ],
    ids=lambda x: str(x)[:9],
)
def test_rerun_replaces_own_files(program, command, tmp_path, monkeypatch, capsys):
    """Whatever their endings are; an empty file loses nothing."""
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert program.main(command.split()) == 0, capsys.readouterr().err
    for path in tmp_path.iterdir():
        assert path.read_bytes()
        path.write_bytes(b"")
        assert program.main(command.split()) == 0
        assert kind_of(path) in command or path.suffix in (".md", ".html", "")


def test_python_output_replaces_own_kind_only(tmp_path):
    robot, notes = tmp_path / "robot.toml", tmp_path / "notes.csv"
    robot.write_bytes(SCARA.read_bytes())
    notes.write_text("joint, remark\n1, squeaks\n")
    fit = load(FIT)
    for write in (
        lambda: write_json(robot, fit.file),
        lambda: fit.export(toml=tmp_path / "new.toml", mjcf=notes),
        lambda: fit.export(urdf=robot),
    ):
        with pytest.raises(BadInputError, match=r"already exists and is a .*, not a "):
            write()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.csv", "robot.toml"]
    assert robot.read_bytes() == SCARA.read_bytes()
    fit.export(toml=robot)
    assert read_robot(robot).parameters != read_robot(SCARA).parameters
