"""Where a newcomer would stop: the program says what to type next."""

import pytest
from conftest import REPLAY
from fits_of_records import short_recording, signals_of

from acquisition.robot import load_robot
from identification.commands import main
from identification.study import border_line

SCARA = REPLAY / "scara" / "session.mcap"


def answer(capsys, *arguments: object) -> str:
    assert main([str(x) for x in arguments]) == 0
    return capsys.readouterr().out


def test_table_instead_of_recording(capsys, tmp_path):
    table = tmp_path / "x.csv"
    table.write_text("t,q\n0,1\n")
    assert main(["fit", str(table)]) == 1
    assert f"`robot-acquire import {table} --robot ROBOT.toml" in capsys.readouterr().err


def test_written_files_show_how_to_open(capsys, tmp_path):
    report, picture = tmp_path / "a.html", tmp_path / "a.rrd"
    said = answer(capsys, "fit", SCARA, "--method", "wls", "--report", report, "--rrd", picture)
    assert said.endswith(f"Report: {report}\nPlots: rerun --bind 127.0.0.1 {picture}\n")


def test_study_reports_run_time_and_zeros(capsys, tmp_path):
    text = (REPLAY / "scara" / "robot.toml").read_text()
    assert "Fc2 = " in text
    robot = tmp_path / "robot.toml"
    robot.write_text("".join(line for line in text.splitlines(True) if not line.startswith("Fc2")))
    assert border_line(load_robot(REPLAY / "emps" / "robot.toml")) == ()
    (line,) = border_line(load_robot(robot))
    assert line.endswith("Fc2")
    said = answer(capsys, "study", robot, "--runs", "1", "--duration-s", "2", "--workers", "1")
    assert line in said
    assert said.endswith(" s per run\n")


def test_edited_description_beside_recording(capsys, tmp_path):
    recording, robot = tmp_path / "session.mcap", tmp_path / "robot.toml"
    stored = signals_of(short_recording(recording, SCARA)).robot.files["robot.toml"]
    told = (
        f"{robot} differs from the description in session.mcap, which was used: --robot "
        f"{robot} uses it"
    )
    for old, new, differs in (
        (b"", b"", False),
        (b"hz = 5.0", b"hz = 6.0", True),
        (b'"SCARA"', b'"another"', False),
    ):
        robot.write_bytes(stored.replace(old, new, 1))
        assert (told in answer(capsys, "fit", recording, "--method", "wls")) == differs
    robot.write_bytes(stored.replace(b"hz = 5.0", b"hz = 6.0"))
    assert "differs from the description" not in answer(
        capsys, "fit", recording, "--method", "wls", "--robot", robot
    )


def test_robot_without_urdf(capsys, tmp_path):
    out = tmp_path / "robot.toml"
    said = answer(capsys, "init", "--dh", "rpR", "--bandwidth-hz", "5", "-o", out)
    robot, text = load_robot(out), out.read_text()
    assert [joint.type for joint in robot.joints] == ["revolute", "prismatic", "revolute"]
    assert robot.bandwidth_hz == 5.0
    assert text.count("dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 } # FILL IN") == 3
    assert "URDF" not in text
    assert "3 joints of rpR" in said


@pytest.mark.parametrize(
    "given", [[], ["--dh", "RX"], ["arm.urdf", "--dh", "RR"], ["--dh", "RR", "--joints", "a,b"]]
)
def test_init_needs_urdf_or_letters(capsys, given):
    assert main(["init", *given]) == 1
    assert "--dh" in capsys.readouterr().err
