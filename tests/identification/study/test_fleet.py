"""Fleets: a row per recording, changes marked, runs that go on where they stopped, the table."""

import csv
import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pyarrow.parquet
import pytest
from conftest import REPLAY, robot_named

from acquisition.robot import robot_from_files
from identification import study
from identification.commands import main
from identification.data import Work, load_signals
from identification.regression import Overrides
from identification.report import Parameter
from identification.results import identify

BEGAN = datetime(2026, 3, 2, 6, 0, tzinfo=UTC)
COUNT = 4  # recordings of an axis; the last has half as much viscous friction again


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A folder with weekly recordings of an axis whose friction grows with a step,
    the newest name first.
    """
    folder, robot = tmp_path_factory.mktemp("fleet") / "arm", robot_named("emps")
    folder.mkdir()
    described = robot.files["robot.toml"].replace(b"Fv1 = 203.5034", b"Fv1 = 305.0")
    worn = robot_from_files({"robot.toml": described}, "worn")
    for k, simulated in enumerate((*[robot] * (COUNT - 1), worn)):
        q_ref = study.random_reference(
            robot, duration_s=3.0, sample_rate_hz=1000.0, seed=k, period_s=3.0
        )
        signals = study.closed_loop(
            simulated, q_ref, 1000.0, noise=study.Noise(effort_percent=2.0), seed=k
        )
        dated = replace(
            signals, robot=robot, t_s=signals.t_s + (BEGAN + timedelta(weeks=k)).timestamp()
        )
        study.write_signals(folder / f"{COUNT - k}.mcap", dated, source="a test")
    return folder


def run(folder, say=lambda text: None, **how):
    (folder.parent / "store").mkdir(exist_ok=True)
    return study.run_fleet(
        study.found_recordings([folder], **how), "wls", folder.parent / "store", Work(), say
    )


def test_table_has_each_fit_and_friction_step(fleet, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    shutil.copytree(fleet, tmp_path / "arm")
    (tmp_path / "arm" / "cut.mcap").write_bytes((fleet / "1.mcap").read_bytes()[:50_000])
    assert (
        main(["fleet", str(tmp_path / "arm"), "-o", str(tmp_path / "fleet.csv"), "--workers", "2"])
        == 0
    )
    with (tmp_path / "fleet.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [Path(row["file"]).stem for row in rows] == ["4", "3", "2", "1", "cut"], (
        "by date, not by name"
    )
    for k, row in enumerate(rows[:COUNT]):
        fit = identify(load_signals(row["file"]), Overrides())
        found = [row[key] for key in ("sha256", "robot", "method", "status", "verdict")]
        assert found == [fit.problem.signals.sha256, "EMPS", "iv", fit.status, fit.trust.verdict]
        assert datetime.fromisoformat(row["start"]) == BEGAN + timedelta(weeks=k)
        assert float(row["torque_error_percent"]) == fit.errors[-1].moving_relative_error_percent
        for j, name in enumerate(fit.estimate.names):
            half = 0.5 * (fit.intervals.high[j] - fit.intervals.low[j])
            assert (float(row[name]), float(row[f"{name}_half_width"])) == (
                fit.estimate.beta[j],
                half,
            )
    before, after = float(rows[-3]["Fv1"]), float(rows[-2]["Fv1"])
    assert (before, after) == pytest.approx((203.5, 305.0), rel=0.05)
    change = f"Fv1 {before:.4g} to {after:.4g} N s/m"
    assert [row["changed"] for row in rows] == ["", "", "", change, ""]
    assert (rows[-1]["status"], rows[-1]["Fv1"], "is truncated" in rows[-1]["reason"]) == (
        "failed",
        "",
        True,
    )
    assert [
        "1.mcap " in line for line in capsys.readouterr().out.splitlines() if change in line
    ] == [True]


def made_row(k, x, half, **others):
    parameters = {"p": Parameter(name="p", value=x, low=x - half, high=x + half, unit="kg")}
    row = {
        "file": f"cell/{k}.mcap",
        "robot": "R",
        "start": BEGAN + timedelta(days=k),
        "parameters": parameters,
    }
    return study.FleetRow(**{**row, **others})


def test_only_values_beyond_intervals_marked(tmp_path):
    rows = study.with_changes(
        [made_row(0, 10.0, 1.0), made_row(1, 11.9, 1.0), made_row(2, 8.9, 1.9)]
    )
    assert [row.changed for row in rows] == ["", "", "p 11.9 to 8.9 kg"]
    study.write_table(tmp_path / "fleet.parquet", rows)
    table = pyarrow.parquet.read_table(tmp_path / "fleet.parquet")
    assert table.schema.field("p_half_width").metadata == {b"unit": b"kg"}
    assert [row["start"] for row in table.to_pylist()] == [row.start for row in rows]
    for other in (
        {"robot": "S"},
        {"file": "b/1.mcap"},
        {"method": "wls"},
        {"verdict": "do not use"},
        {"start": None},
    ):
        rows = [made_row(0, 10.0, 1.0), made_row(1, 20.0, 1.0, **other), made_row(2, 10.5, 1.0)]
        assert [row.changed for row in study.with_changes(rows)] == ["", "", ""], other


def test_run_resumes_where_last_stopped(fleet, tmp_path):
    def stop(text):
        fits.append(text)
        if text.startswith("2 of"):
            raise KeyboardInterrupt

    folder, fits, others = Path(shutil.copytree(fleet, tmp_path / "arm")), list[str](), list[str]()
    with pytest.raises(KeyboardInterrupt):
        run(folder, stop)
    rows = run(folder, fits.append)
    assert run(folder, fits.append) == rows
    assert fits == [f"{k} of {COUNT}: {folder / f'{k}.mcap'}" for k in range(1, COUNT + 1)], (
        "each once in three runs"
    )
    text = (REPLAY / "emps" / "robot.toml").read_text() + "\n[identification]\ncutoff_hz = 40\n"
    (tmp_path / "robot.toml").write_text(text)
    assert (
        run(folder, others.append, robot=tmp_path / "robot.toml")[0].parameters
        != rows[0].parameters
    )
    shutil.copy(fleet / "1.mcap", folder / "2.mcap")
    assert len({row.sha256 for row in run(folder, others.append)}) == COUNT - 1
    assert others[COUNT:] == [f"{COUNT} of {COUNT}: {folder / '2.mcap'}"]


def test_stored_fits_of_other_versions_open_or_refit(fleet, tmp_path):
    (folder := tmp_path / "arm").mkdir()
    shutil.copy(fleet / "1.mcap", folder)
    rows = run(folder)
    (stored,) = (tmp_path / "store").iterdir()
    content = json.loads(stored.read_text())
    older = {"Fv1": {"value": 1.0, "low": 0.0, "high": 2.0, "unit": "N s/m"}}  # without its name
    for change, made in (({"folder": "arm"}, 0), ({"parameters": older}, 1), ({"file": 1}, 1)):
        fits = list[str]()
        stored.write_text(json.dumps({**content, **change}))
        assert (run(folder, fits.append), len(fits)) == (rows, made)


def test_folder_of_one_robot_fitted_together(fleet, tmp_path):
    (tmp_path / "arm" / "mixed").mkdir(parents=True)
    for file in (fleet / "1.mcap", REPLAY / "scara" / "session.mcap"):
        shutil.copy(file, tmp_path / "arm" / "mixed")
    shutil.copytree(fleet, tmp_path / "arm" / "month")
    month, mixed = run(tmp_path / "arm", by_folder=True)
    assert (Path(month.file).name, month.start, len(month.sha256.split())) == (
        "month",
        BEGAN,
        COUNT,
    )
    assert "session.mcap: joints = 2: expected 1, as in 1.mcap" in mixed.reason


def test_program_error_is_row_and_retried(fleet, monkeypatch):
    monkeypatch.setattr("identification.study.fleet.identify", lambda *arguments, **options: 1 // 0)
    assert {row.reason[:28] for row in run(fleet)} == {"unexpected ZeroDivisionError"}
    assert not list((fleet.parent / "store").iterdir())


def test_bad_input_refused(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for folder, out, text in (
        ("none", "f.csv", "none: contains no recordings (*.mcap)\n"),
        ("empty", "none/f.csv", "none does not exist. Create it, or choose another file.\n"),
        ("empty", "f.xlsx", "f.xlsx: ending = '.xlsx': expected .parquet or .csv\n"),
    ):
        assert main(["fleet", str(tmp_path / folder), "-o", str(tmp_path / out)]) == 1
        (line,) = capsys.readouterr().err.splitlines(keepends=True)
        assert line.endswith(text)
    assert list(tmp_path.iterdir()) == [tmp_path / "empty"], "nothing is made"
    (tmp_path / "empty" / "notes.mcap").write_text("these are notes")
    assert main(["fleet", str(tmp_path / "empty"), "-o", str(tmp_path / "f.parquet")]) == 3
    assert "no recording could be fitted: " in capsys.readouterr().err
