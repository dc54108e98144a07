"""A file in the place of another, and a description that has more than the fit."""

import json
import shutil

import pytest
from command_runs import refused, run
from conftest import ACQUIRE, REPLAY
from friction_models import USUAL, described

from identification.commands import main
from identification.design import prior_information

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
def test_non_fit_named_with_remedy(here, capsys, command, name, text, log):
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
def test_non_recording_named(here, capsys, program, command, name, kind):
    shutil.copy(FIT, here)
    run_main = main if program == "identify" else ACQUIRE.main
    assert run_main(command.replace("FILE", name).split()) == 1
    told = capsys.readouterr().err
    assert (
        f"{name}: this is {kind}, not a recording. Pass a recording of `robot-acquire record` or "
        in told
    )


def errors_of(capsys, robot, *options):
    """The lines of warnings and the torque errors of the stored fit by a description."""
    status, out, err = run(capsys, "validate", FIT, SESSION, "--robot", robot, "--json", "v.json")
    assert (status, err) == (0, "")
    with open("v.json") as file:
        content = json.load(file)
    return [li for li in out.splitlines() if " of the description: " in li], content["joints"]


LINE = "Warning: {} has no {} of the description: zero, as in the fit"


@pytest.mark.parametrize(
    ("terms", "missing"),
    [
        ([["viscous", "coulomb", "root", "load"], ["viscous", "coulomb", "load"]], "Fr1, mu1, mu2"),
        ([USUAL, USUAL], "Off1, Off2"),
        ([["viscous", "coulomb"]] * 2, ""),
    ],
)
def test_missing_terms_reported_and_zero(here, capsys, terms, missing):
    own, errors = errors_of(capsys, SCARA / "robot.toml")
    assert own == []
    (here / "more.toml").write_bytes(described("scara", terms).files["robot.toml"])
    told, with_more = errors_of(capsys, here / "more.toml")
    assert told == ([LINE.format(FIT, missing)] if missing else [])
    assert with_more == errors
    robot = described("scara", terms)
    warnings = prior_information(robot, fit=FIT).warnings
    assert [f"Warning: {text}" for text in warnings] == told


def test_several_recordings_report_missing_once(here, capsys):
    more = here / "more.toml"
    more.write_bytes(described("scara", [USUAL] * 2).files["robot.toml"])
    assert run(capsys, "simulate", "robot.toml", "-o", "two.mcap", "--duration-s", 2)[0] == 0
    said = run(capsys, "validate", FIT, "log.mcap", "two.mcap", "--robot", more)[1]
    assert said.replace("\n  ", " ").count(" has no Off1, Off2 of the description") == 1
    assert (
        run(capsys, "fit", "log.mcap", "--method", "wls", "--essential", "--json", "few.json")[0]
        == 0
    )
    content = json.loads((here / "few.json").read_text())
    content["left_out"].append({"name": content["parameters"].pop()["name"], "sigma": 0.1})
    (here / "few.json").write_text(json.dumps(content))
    assert "of the description" not in run(capsys, "validate", "few.json", "log.mcap")[1]
