"""A file in the place of another."""

import shutil

import pytest
from command_runs import refused
from conftest import ACQUIRE, REPLAY

from identification.commands import main

SCARA = REPLAY / "scara"
SESSION, FIT = SCARA / "session.mcap", SCARA / "fit.json"
A_FIT = "expected a fit as `robot-identify fit {} --json FIT.json` writes it\n"


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(SESSION, "log.mcap")
    shutil.copy(SESSION, "renamed")
    shutil.copy(SCARA / "robot.toml", tmp_path)
    (tmp_path / "cut.json").write_text(FIT.read_text()[:300])
    (tmp_path / "table.csv").write_text("t,q1,u1\n0,1,2\n")
    (tmp_path / "arm.urdf").write_text('<?xml version="1.0"?>\n<!-- mine -->\n<robot name="a"/>')
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        f"compare {FIT} FILE",
        f"compare FILE {FIT}",
        "export FILE --toml new.toml",
        f"validate FILE {SESSION}",
        "excite robot.toml --fit FILE -o ref.csv",
        f"fit {SESSION} --start FILE",
        f"view {SESSION} --follow --fit FILE -o view.rrd",
    ],
)
@pytest.mark.parametrize(
    ("name", "text", "log"),
    [
        ("log.mcap", "is a recording", "log.mcap"),
        ("renamed", "is a recording", "renamed"),
        ("robot.toml", "is a robot.toml", "LOG.mcap"),
        ("arm.urdf", "is a URDF", "LOG.mcap"),
        ("table.csv", "not a fit: no JSON: ", "LOG.mcap"),
        ("cut.json", "not a fit: Input data was truncated", "LOG.mcap"),
    ],
)
def test_what_is_no_fit_is_named_with_the_way_to_one(here, capsys, command, name, text, log):
    if command == f"compare {FIT} FILE" and name in ("robot.toml", "arm.urdf"):
        return  # which are the prior
    told = refused(capsys, *command.replace("FILE", name).split())
    assert told.startswith(f"robot-identify: {name}: {text}")
    assert told.endswith(A_FIT.format(log))


@pytest.mark.parametrize(
    ("program", "command"),
    [("identify", "fit FILE"), ("identify", f"validate {FIT} FILE"), ("acquire", "info FILE")],
)
@pytest.mark.parametrize(
    ("name", "kind"), [("fit.json", "a result as JSON"), ("robot.toml", "a robot.toml")]
)
def test_what_is_no_recording_is_named(here, capsys, program, command, name, kind):
    shutil.copy(FIT, here)
    run_main = main if program == "identify" else ACQUIRE.main
    assert run_main(command.replace("FILE", name).split()) == 1
    told = capsys.readouterr().err
    assert f"{name}: is {kind}: expected a recording, as `robot-acquire record` or " in told
