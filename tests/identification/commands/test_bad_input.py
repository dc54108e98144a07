"""Mistakes of a user of `robot-identify`: one line each, nothing lost, nothing misunderstood."""

import dataclasses
import json
import shutil

import msgspec
import pytest
from command_runs import refused, run
from conftest import REPLAY, robot_named
from made_up_recordings import header

from acquisition.errors import BadInputError
from acquisition.recording import RecordingWriter, read_recording
from acquisition.robot import robot_from_files
from identification.data import load_signals
from identification.methods import Iteration
from identification.regression import Overrides
from identification.results import identify_iv, identify_ls

SESSION = REPLAY / "scara" / "session.mcap"


@pytest.fixture
def robot_file(tmp_path):
    place = tmp_path / "r.toml"
    place.write_text((REPLAY / "scara" / "robot.toml").read_text())
    return place


def test_output_never_overwrites_input(capsys, tmp_path, robot_file):
    fit = tmp_path / "fit.json"
    shutil.copy(REPLAY / "scara" / "fit.json", fit)
    before = {path: path.read_bytes() for path in (robot_file, fit)}
    for command in (
        ["base", robot_file, "--json", robot_file],
        ["simulate", robot_file, "-o", robot_file],
        ["fit", SESSION, "--robot", robot_file, "--rrd", robot_file],
        ["fit", SESSION, "--method", "iv", "--start", fit, "--json", fit],
        ["validate", fit, SESSION, "--json", fit],
    ):
        assert "the output is also an input" in refused(capsys, *command)
        assert before == {path: path.read_bytes() for path in before}


def test_volts_never_become_newton_metres(tmp_path):
    text = (REPLAY / "scara" / "robot.toml").read_text()
    recording = read_recording(SESSION)
    kept = [li for li in text.splitlines() if not li.startswith(("drive_gain", "effort_unit"))]
    in_volts = "\n".join(f'{li}\neffort_unit = "V"' if li == "[[motor]]" else li for li in kept)
    volts = robot_from_files({"robot.toml": in_volts.encode()}, "v.toml")
    path = tmp_path / "volts.mcap"
    with RecordingWriter(path, header(volts)) as writer:
        writer.samples(recording.samples)
    assert load_signals(path).robot.effort_units[0] == "V"
    with pytest.raises(
        BadInputError, match=r"unit of motor .* in robot SCARA = .*: expected V, as recorded"
    ):
        load_signals(path, robot_named("scara"))


@pytest.mark.parametrize(
    ("key", "value", "cutoff_hz", "expected"),
    [
        (None, None, "1e-9", "cut-off = 1e-09 Hz: 5 periods are longer"),
        (
            "bandwidth_hz",
            "1e-9",
            "25",
            "controller.bandwidth_hz = 1e-09: expected at least 0.",
        ),
        ("sample_rate_hz", "1e9", None, "expected at most 2e+07 steps"),
    ],
)
def test_impossible_cutoffs_and_controllers(capsys, robot_file, key, value, cutoff_hz, expected):
    lines = [
        f"{key} = {value}" if key and li.startswith(key) else li
        for li in robot_file.read_text().splitlines()
    ]
    robot_file.write_text("\n".join(lines))
    options = ["--robot", robot_file, "--method", "iv"] if key else []
    options += ["--cutoff-hz", cutoff_hz] if cutoff_hz else []
    assert expected in refused(capsys, "fit", SESSION, *options)


def test_short_simulations_and_bad_folders(capsys, tmp_path, robot_file):
    out = tmp_path / "x.mcap"
    short = refused(capsys, "simulate", robot_file, "-o", out, "--duration-s", "0.0001")
    assert "0.1 samples: expected 100 to" in short
    assert "/dev/null: the folder cannot be created" in refused(
        capsys, "demo", "--out", "/dev/null"
    )
    with pytest.raises(SystemExit):
        run(capsys, "simulate", robot_file, "-o", out, "--seed", "-1")
    assert "--seed" in capsys.readouterr().err
    assert not out.exists()


def changed_fit(folder, change):
    content = json.loads((REPLAY / "scara" / "fit.json").read_text())
    change(content)
    (folder / "fit.json").write_text(json.dumps(content))
    return folder / "fit.json"


def test_huge_start_values_reported(capsys, tmp_path):
    fit, out = (
        changed_fit(tmp_path, lambda c: [p.update(value=1e200) for p in c["parameters"]]),
        tmp_path / "iv.json",
    )
    status, _, err = run(capsys, "fit", SESSION, "--method", "iv", "--start", fit, "--json", out)
    assert (status, err) == (0, "")
    assert json.loads(out.read_text())["iterations"][0]["instruments"] == "reference"


def test_diverged_fit_reported_at_every_use(capsys, tmp_path):
    good, bad = (
        REPLAY / "scara" / "fit.json",
        changed_fit(tmp_path, lambda c: c.update(status="diverged")),
    )
    assert f"{bad}: its status is diverged" in run(capsys, "validate", bad, SESSION)[1]
    assert f"{bad}: its status is diverged" in run(capsys, "compare", good, bad)[1]
    assert "its status is" not in run(capsys, "validate", good, SESSION)[1]


def test_wrong_bandwidth_is_no_foreign_reference():
    """The reference is compared with the position as it was measured, not as the stated
    bandwidth lets it through.
    """
    signals = load_signals(SESSION)
    low = msgspec.structs.replace(signals.robot.controller, bandwidth_hz=0.45)
    slow = dataclasses.replace(signals, robot=dataclasses.replace(signals.robot, controller=low))
    assert (
        identify_iv(slow, Overrides(cutoff_hz=25.0, decimation=20), Iteration()).status
        == "converged"
    )


def test_recorder_warnings_appear_in_fit(tmp_path):
    recording = read_recording(SESSION)
    path = tmp_path / "warned.mcap"
    with RecordingWriter(path, header(recording.robot)) as writer:
        writer.samples(recording.samples)
        writer.event(
            int(recording.samples["stamp_ns"][-1]), "warning", "SYNC came every 4 ms: expected 8 ms"
        )
    fit = identify_ls(load_signals(path), Overrides())
    assert "recording: SYNC came every 4 ms: expected 8 ms" in fit.warnings
