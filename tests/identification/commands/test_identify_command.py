"""`robot-identify` as a user meets it: tables, files, and one line for every mistake."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_runs import refused, run
from conftest import REPLAY, robot_named
from made_up_recordings import header

from acquisition.recording import RecordingWriter, read_recording, sample_dtype
from acquisition.robot import Robot, robot_from_files

SESSION, SCARA = REPLAY / "scara" / "session.mcap", REPLAY / "scara" / "robot.toml"


def test_fit_prints_table_and_writes_json(capsys, tmp_path):
    files = "--json", tmp_path / "fit.json", "--report", tmp_path / "fit.md"
    status, out, err = run(capsys, "fit", SESSION, *files)
    assert (status, err) == (0, "")
    assert out.startswith("SCARA: instrumental variables (IV), converged after ")
    assert (tmp_path / "fit.md").read_text().startswith(f"# {out.splitlines()[0]}")
    assert "fit.txt: ending = '.txt'" in refused(
        capsys, "fit", SESSION, "--report", tmp_path / "fit.txt"
    )
    assert "\nParameters         8 of 8 well determined; " in out
    fit = json.loads((tmp_path / "fit.json").read_text())
    assert [p["name"] for p in fit["parameters"]] == [
        "ZZ1R",
        "Fv1",
        "Fc1",
        "ZZ2",
        "MX2",
        "MY2",
        "Fv2",
        "Fc2",
    ]
    assert (fit["parameters"][0]["expression"], fit["parameters"][0]["unit"]) == (
        "ZZ1 + 0.25 M2",
        "kg m²",
    )
    assert {
        "method",
        "status",
        "relative_error_percent",
        "condition_number",
        "rows",
        "provenance",
    } <= set(fit)
    assert (fit["sample_rate_hz"], fit["cutoff_hz"], fit["decimation"]) == (1000.0, 25.0, 40)
    assert [j["name"] for j in fit["joints"]] == ["shoulder", "elbow"]
    assert len(fit["provenance"]["sha256"]) == 64
    assert f"{fit['parameters'][0]['value']:.8f}"[:5] in out


def test_same_description_prints_same_bytes(capsys):
    """With the status of a fit whose verdict is not required to be trust."""
    command = "fit", SESSION, "--method", "wls"
    told = run(capsys, *command)
    assert (told[0], told == run(capsys, *command, "--robot", SCARA)) == (0, True)


def test_requested_verdict_sets_exit_status(capsys, tmp_path):
    status, _, err = run(capsys, "fit", SESSION, "--require", "trust")
    assert (status, err) == (0, "")
    options = "--method", "wls", "--require", "trust", "--json", tmp_path / "a.json"
    status, out, err = run(capsys, "fit", SESSION, *options)
    assert (status, err.count("\n")) == (3, 1)
    assert err.startswith("robot-identify: not to be trusted: ")
    assert "\n  delay  " in out
    assert json.loads((tmp_path / "a.json").read_text())["verdict"] == "caution"


def test_options_and_keys_change_fit(capsys, tmp_path):
    robot = tmp_path / "robot.toml"
    robot.write_text(SCARA.read_text() + '\n[identification]\nspan = "all"\ndecimation = 20\n')
    for name, options in {
        "none.json": ["--cutoff-hz", "none", "--method", "ols", "--robot", robot],
        "essential.json": ["--essential"],
    }.items():
        assert run(capsys, "fit", SESSION, *options, "--json", tmp_path / name)[0] == 0
    none, essential = (
        json.loads((tmp_path / n).read_text()) for n in ("none.json", "essential.json")
    )
    assert (none["cutoff_hz"], none["decimation"], none["method"], none["span"]) == (
        None,
        20,
        "ols",
        "all samples",
    )
    assert [p["name"] for p in essential["parameters"]] == essential["essential"]["names"]


def test_simulation_is_repeatable(capsys, tmp_path):
    options = ["--duration-s", 2, "--effort-noise-percent", 1]
    asymmetric = REPLAY / "emps" / "robot_published_asymmetric.toml"
    assert "has no [parameters], which simulations need" in refused(
        capsys, "simulate", asymmetric, "-o", tmp_path / "c.mcap"
    )
    for name in ("a.mcap", "b.mcap"):
        assert run(capsys, "simulate", SCARA, "-o", tmp_path / name, *options)[0] == 0
    a, b = (read_recording(tmp_path / name).samples for name in ("a.mcap", "b.mcap"))
    assert a.tobytes() == b.tobytes()


def test_recording_replaced_only_on_request(capsys, tmp_path):
    log = tmp_path / "session.mcap"
    log.write_bytes(b"old")
    simulate = ["simulate", SCARA, "--duration-s", 1, "-o", log]
    told = refused(capsys, *simulate)
    assert told.startswith(f"robot-identify: {log}: the file already exists")
    assert told.rstrip().endswith("(--out, --overwrite).")
    told = refused(capsys, "demo", "--out", tmp_path)
    assert str(log) in told
    assert told.rstrip().endswith("(--out, --overwrite).")
    assert "--overwrite" not in refused(capsys, "fit", SESSION, "--json", log)
    assert (log.read_bytes(), run(capsys, *simulate, "--overwrite")[0]) == (b"old", 0)
    assert log.stat().st_size > 1000


def write_samples(path: Path, robot: Robot, samples: np.ndarray) -> None:
    with RecordingWriter(path, header(robot)) as writer:
        writer.samples(samples)


def test_gaps_short_recordings_standstill_named(capsys, tmp_path):
    robot, samples, path = (
        robot_named("scara"),
        np.array(read_recording(SESSION).samples[:4000]),
        tmp_path / "log.mcap",
    )
    still, half, far = samples.copy(), samples.copy(), samples.copy()
    far["stamp_ns"][1500:] += 2 * 10**12
    still["position"], half["position"][:, 1] = samples["position"][0], samples["position"][0, 1]
    for rows, message in (
        (
            far,
            "samples: the time step after 1.4990 s is 2000 s, but the period is 1.000 ms. Split",
        ),
        (samples[3000:3300], "needs 1200, for 30 decimated rows"),
        (samples[:1], "samples = 1: expected at least 2"),
        (still, "no joint moves"),
        (half, "parameters = Fv2, Fc2: they have no effect on the torque"),
    ):
        write_samples(path, robot, rows)
        assert message in refused(capsys, "fit", path)


def test_faulted_session_is_fitted(capsys, tmp_path):
    """Answers were lost before it, and the last rows have gaps: the line `rows` names them."""
    samples = np.array(read_recording(SESSION).samples)
    rows = np.delete(samples, np.r_[4000:4012, 12650:12660, 12670:12690])
    write_samples(tmp_path / "log.mcap", robot_named("scara"), rows)
    status, out, _ = run(capsys, "fit", tmp_path / "log.mcap", "--method", "iv", "--all")
    assert status == 0
    assert "42 are missing in 3 gap(s)" in " ".join(out.split())
    assert "Verdict: trust" in out


def test_unknown_gains_give_volts_and_warning(capsys, tmp_path):
    text = (REPLAY / "emps" / "robot.toml").read_text()
    text = text.replace("drive_gain = 35.15065188\n", "").replace(
        'drive_gain_unit = "N/V"', 'effort_unit = "V"'
    )
    robot = robot_from_files({"robot.toml": text.replace("span = ", "#").encode()}, "emps.toml")
    t = np.arange(6000) / 1000
    samples = np.zeros(6000, sample_dtype(1, reference=False))
    samples["stamp_ns"] = np.arange(6000) * 1_000_000
    w = 2 * np.pi * 0.5
    samples["position"][:, 0], dq, ddq = (
        0.1 * np.sin(w * t),
        0.1 * w * np.cos(w * t),
        -0.1 * w**2 * np.sin(w * t),
    )
    samples["effort"][:, 0] = 2.7 * ddq + 5.8 * dq + 0.6 * np.sign(dq)
    write_samples(tmp_path / "volts.mcap", robot, samples)
    status, out, _ = run(capsys, "fit", tmp_path / "volts.mcap", "--json", tmp_path / "fit.json")
    assert status == 0
    assert "drive gains are not known: torques and parameters are in V, not in N m" in out
    first, viscous, dry = json.loads((tmp_path / "fit.json").read_text())["parameters"][:3]
    assert [(p["name"], p["unit"]) for p in (first, viscous, dry)] == [
        ("M1", "V s²/m"),
        ("Fv1", "V s/m"),
        ("Fc1", "V"),
    ]
    assert first["value"] == pytest.approx(2.7, rel=0.01)


ONE = {"name": "MX2", "value": 1, "sigma": 1, "unit": "kg m"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": 1}, "not a fit"),
        ({"format": 9, "parameters": []}, "format = 9: expected 1"),
        ({"parameters": []}, "expected those of the recording's robot"),
        (
            {"parameters": [ONE | {"name": "ZZ9"}]},
            "parameters = 'ZZ9': expected those of the recording's robot",
        ),
        (
            {"parameters": [ONE | {"unit": "A"}]},
            "MX2.unit = 'A': expected kg m, as the recording's robot has it",
        ),
        (
            {"parameters": [ONE | {"low": 1.5, "high": 0.5}]},
            "expected finite values, sigmas of at least 0, low not above high",
        ),
    ],
)
def test_unrelated_fits_refused(capsys, tmp_path, changes, message):
    path = tmp_path / "fit.json"
    path.write_text(json.dumps({"format": 1, "method": "wls", "status": "solved"} | changes))
    assert message in refused(capsys, "validate", path, SESSION)
    path.write_text("{")
    assert "not a fit" in refused(capsys, "validate", path, SESSION)
