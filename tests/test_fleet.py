"""Fleets: a row per recording, runs that go on where they stopped, control limits, the table and its picture."""

import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from conftest import REPLAY, robot_named
from test_viewer import Written

from acquisition.recording import read_recording
from acquisition.robot import robot_from_files
from identification.commands import main
from identification.data import Recordings, Work, load_signals
from identification.methods import identify
from identification.regression import Overrides
from identification.study import (
    FleetSettings,
    Noise,
    Row,
    Value,
    closed_loop,
    control_limits,
    drifts,
    found_recordings,
    random_reference,
    run_fleet,
    write_signals,
)
from identification.study import fleet as fleet_module

BEGAN = datetime(2026, 3, 2, 6, 0, tzinfo=UTC)
WEEK_S = 7 * 86400.0
COUNT = 6  # recordings of an arm; the last has half as much viscous friction again


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A folder with weekly recordings of an axis whose friction grows with a step, the newest name first."""
    folder = tmp_path_factory.mktemp("fleet") / "arm"
    (folder / "2026").mkdir(parents=True)
    robot = robot_named("emps")
    text = robot.files["robot.toml"].decode()
    assert "Fv1 = 203.5034" in text
    worn = robot_from_files({"robot.toml": text.replace("Fv1 = 203.5034", "Fv1 = 305.0").encode()}, "worn")
    for k in range(COUNT):
        simulated = worn if k == COUNT - 1 else robot
        q_ref = random_reference(robot, duration_s=3.0, sample_rate_hz=1000.0, seed=k, period_s=3.0)
        signals = closed_loop(simulated, q_ref, 1000.0, noise=Noise(effort_percent=2.0), seed=k)
        dated = replace(signals, robot=robot, t_s=signals.t_s + BEGAN.timestamp() + k * WEEK_S)
        write_signals(folder / "2026" / f"{COUNT - k}.mcap", dated, source="a test")
    return folder


def in_this_process(tasks):
    return Work()


def run(folder, kept, settings=None, *, work_for=in_this_process, say=lambda done, file: None):
    kept.mkdir(exist_ok=True)
    return run_fleet(found_recordings([folder]), settings or FleetSettings(), kept, work_for, say)


@pytest.fixture
def fits(monkeypatch):
    """Names of the recordings that are fitted."""
    names = []

    def counted(recordings, *arguments, **options):
        names.extend(source.recording for source in recordings.sources)
        return identify(recordings, *arguments, **options)

    monkeypatch.setattr(fleet_module, "identify", counted)
    return names


@pytest.fixture(scope="module")
def written(fleet, tmp_path_factory):
    """Folder, and what the command printed, of a fleet with a damaged recording, a copy and no recording."""
    out = tmp_path_factory.mktemp("out")
    folder = out / "arm"
    shutil.copytree(fleet, folder)
    damaged = (folder / "2026" / "1.mcap").read_bytes()
    (folder / "damaged.mcap").write_bytes(damaged[: len(damaged) // 2])
    (folder / "notes.mcap").write_text("these are notes")
    shutil.copy(folder / "2026" / "2.mcap", folder / "2026" / "2 again.mcap")
    arguments = ["fleet", str(folder), "-o", str(out / "fleet.parquet"), "--rrd", str(out / "fleet.rrd")]
    assert main([*arguments, "--workers", "2"]) == 0
    return out


@pytest.mark.slow
def test_a_row_is_the_fit_of_its_recording(written):
    """The table has what `identify` gives, in the order of the dates, not of the names."""
    table = pyarrow.parquet.read_table(written / "fleet.parquet")
    rows = table.to_pylist()
    fitted = [row for row in rows if row["status"] == "converged"]
    assert [row["start"] for row in fitted] == [
        datetime.fromtimestamp(BEGAN.timestamp() + k * WEEK_S, UTC) for k in range(COUNT)
    ]
    assert [row["file"].rsplit("/", 1)[1] for row in fitted if "again" not in row["file"]][:4] == [
        "6.mcap",
        "5.mcap",
        "4.mcap",
        "3.mcap",
    ]
    for row in fitted[::3]:
        signals = load_signals(row["file"])
        fit = identify(signals, Overrides())
        assert (row["sha256"], row["robot"], row["method"]) == (signals.sha256, "EMPS", "iv")
        assert row["verdict"] == fit.trust.verdict
        assert row["error_percent"] == fit.errors[-1].relative_error_percent
        assert row["moving_error_percent"] == fit.errors[-1].moving_relative_error_percent
        assert row["standing_error_percent"] == fit.errors[-1].standing_relative_error_percent
        for k, name in enumerate(fit.estimate.names):
            found = row[name], row[f"{name}_low"], row[f"{name}_high"]
            assert found == (fit.estimate.beta[k], fit.intervals.low[k], fit.intervals.high[k])
    assert table.schema.field("Fv1_low").metadata == {b"unit": b"N s/m"}


@pytest.mark.slow
def test_what_failed_is_a_row_with_its_reason(written):
    rows = {
        row["file"].rsplit("/", 1)[1]: row for row in pyarrow.parquet.read_table(written / "fleet.parquet").to_pylist()
    }
    assert len(rows) == COUNT + 3
    assert rows["damaged.mcap"]["status"] == rows["notes.mcap"]["status"] == "failed"
    assert "is cut" in rows["damaged.mcap"]["reason"]
    assert "is not an MCAP file" in rows["notes.mcap"]["reason"]
    assert rows["damaged.mcap"]["Fv1"] is None
    copies = [rows["2.mcap"], rows["2 again.mcap"]]
    assert sorted(row["status"] for row in copies) == ["converged", "copy"]
    assert all(row["sha256"] == copies[0]["sha256"] for row in copies)


@pytest.mark.slow
def test_the_picture_has_the_values_and_their_limits(written, fleet, tmp_path):
    file = Written(written / "fleet.rrd")
    assert file.is_complete()
    series = drifts(run(fleet, tmp_path / "kept", settings=FleetSettings(method="iv")))
    (drift,) = series
    chart = next(chart for chart in drift.charts if chart.name == "Fv1")
    curves = {path.rsplit("/", 1)[1]: line for path, line in file.curves.items() if "/Fv1/" in path}
    t_ns, values = curves["value"]
    first = drift.rows[0].start.timestamp()
    np.testing.assert_allclose(t_ns * 1e-9, first + WEEK_S * np.arange(COUNT), atol=1e-3, err_msg="dates")
    np.testing.assert_array_equal(values, chart.x)
    assert chart.limits is not None
    for key, limit in zip(("centre", "limit_low", "limit_high"), chart.limits, strict=True):
        np.testing.assert_array_equal(curves[key][1], [limit, limit])
    np.testing.assert_array_equal(curves["interval_low"][1], chart.low)
    np.testing.assert_array_equal(curves["interval_high"][1], chart.high)


def test_a_step_of_friction_is_beyond_the_limits_and_the_mass_is_not(fleet, tmp_path):
    (drift,) = drifts(run(fleet, tmp_path / "kept"))
    charts = {chart.name: chart for chart in drift.charts}
    assert charts["Fv1"].outside == [COUNT - 1]
    assert charts["Fv1"].files[COUNT - 1].endswith("/1.mcap")
    assert charts["M1"].outside == []
    assert charts["Fv1"].x[:-1] == pytest.approx(203.5, rel=0.05)
    assert charts["Fv1"].x[-1] == pytest.approx(305.0, rel=0.05)


def test_limits_are_those_of_the_handbook():
    """NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.2: flow rates of ten batches."""
    flow = np.array([49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1])
    assert control_limits(flow) == pytest.approx((50.81, 45.8159, 55.8041), abs=2e-4)
    assert control_limits(flow[:4]) is None


@pytest.mark.slow
def test_a_stopped_run_goes_on_where_it_was(fleet, tmp_path, fits):
    def stop(done, file):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(fleet, tmp_path / "kept", say=stop)
    assert fits == ["1.mcap", "2.mcap"]
    rows = run(fleet, tmp_path / "kept")
    assert fits == [f"{k}.mcap" for k in range(1, COUNT + 1)], "each once in both runs"
    assert run(fleet, tmp_path / "kept") == rows
    assert len(fits) == COUNT
    assert run(fleet, tmp_path / "other") == rows
    assert len(fits) == 2 * COUNT


@pytest.mark.slow
def test_rows_of_other_settings_content_or_versions_are_made_again(fleet, tmp_path, fits):
    folder = tmp_path / "arm"
    folder.mkdir()
    for name in ("1.mcap", "2.mcap"):
        shutil.copy(fleet / "2026" / name, folder)
    first = run(folder, tmp_path / "kept")
    other = run(folder, tmp_path / "kept", FleetSettings(overrides=Overrides(cutoff_hz=40.0)))
    assert len(fits) == 4
    assert first[0].parameters != other[0].parameters
    described = tuple(robot_named("emps").files.items())
    run(folder, tmp_path / "kept", FleetSettings(description=described))
    assert len(fits) == 6
    (folder / "2.mcap").replace(folder / "moved.mcap")  # the same content is not fitted again
    shutil.copy(fleet / "2026" / "3.mcap", folder / "1.mcap")
    names = [row.file.rsplit("/", 1)[1] for row in run(folder, tmp_path / "kept")]
    assert fits[6:] == ["1.mcap"]
    assert sorted(names) == ["1.mcap", "moved.mcap"]
    shutil.copy(folder / "1.mcap", folder / ".1.mcap.partial.mcap")  # as it is while it is written
    assert len(run(folder, tmp_path / "kept")) == 2
    for file in (tmp_path / "kept").iterdir():
        file.write_text(file.read_text()[:100])
    run(folder, tmp_path / "kept")
    assert len(fits) == 9, "damaged rows are made again"
    settings = FleetSettings().digest[:16]
    one, other = (tmp_path / "kept" / f"{row.sha256[:32]}-{settings}.json" for row in run(folder, tmp_path / "kept"))
    shutil.copy(one, other)
    run(folder, tmp_path / "kept")
    assert len(fits) == 10, "a row of another recording is not taken for this one's"


def test_recordings_of_a_folder_are_fitted_together(fleet, tmp_path):
    for name, members in {"monday": "12", "tuesday": "34", "cut": "5"}.items():
        (tmp_path / "arm" / name).mkdir(parents=True)
        for member in members:
            shutil.copy(fleet / "2026" / f"{member}.mcap", tmp_path / "arm" / name)
    (tmp_path / "arm" / "cut" / "7.mcap").write_bytes((fleet / "2026" / "6.mcap").read_bytes()[:50_000])
    kept = tmp_path / "kept"
    kept.mkdir()

    def rows():
        found = found_recordings([tmp_path / "arm"], by_folder=True)
        return {Path(r.file).name: r for r in run_fleet(found, FleetSettings(), kept, in_this_process, lambda *_: None)}

    first = rows()
    assert list(first) == ["tuesday", "monday", "cut"], "by the first of their recordings"
    assert first["cut"].status == "failed"
    assert "7.mcap: is cut" in first["cut"].reason
    members = tuple(load_signals(fleet / "2026" / f"{member}.mcap") for member in "43")
    fit = identify(Recordings(sources=members), Overrides(), method="wls")
    assert first["tuesday"].start == members[0].began
    assert first["tuesday"].error_percent == fit.errors[-1].relative_error_percent
    assert [value.value for value in first["tuesday"].parameters.values()] == fit.estimate.beta.tolist()
    shutil.copy(fleet / "2026" / "6.mcap", tmp_path / "arm" / "monday")
    second = rows()
    assert second["monday"].parameters != first["monday"].parameters, "fitted again with the new recording"
    assert second["tuesday"] == first["tuesday"]
    assert len(list(kept.iterdir())) == 4


def test_a_recording_that_changes_while_the_fleet_is_fitted_is_not_kept_as_another(fleet, tmp_path):
    folder = tmp_path / "arm"
    folder.mkdir()
    shutil.copy(fleet / "2026" / "1.mcap", folder)

    def late(tasks):
        shutil.copy(fleet / "2026" / "2.mcap", folder / "1.mcap")
        return Work()

    (row,) = run(folder, tmp_path / "kept", work_for=late)
    assert row.status == "failed"
    assert "has changed since the run began" in row.reason
    (row,) = run(folder, tmp_path / "kept")
    assert row.is_fitted


def test_a_recording_that_vanishes_while_the_fleet_is_fitted_is_a_row(fleet, tmp_path):
    folder = tmp_path / "arm"
    folder.mkdir()
    for name in ("1.mcap", "2.mcap"):
        shutil.copy(fleet / "2026" / name, folder)

    def late(tasks):
        (folder / "1.mcap").unlink(missing_ok=True)
        return Work()

    rows = {Path(row.file).name: row for row in run(folder, tmp_path / "kept", work_for=late)}
    assert rows["1.mcap"].status == "failed"
    assert rows["1.mcap"].reason.startswith(f"{folder / '1.mcap'}: not found by a worker")
    assert rows["2.mcap"].is_fitted


def test_a_recording_that_a_worker_does_not_find_is_tried_again_the_next_time(fleet, tmp_path):
    class Far(Work):
        def run(self, function, tasks):
            elsewhere = [(tuple(replace(x, path=f"/nowhere/{Path(x.path).name}") for x in t[0]), *t[1:]) for t in tasks]
            return super().run(function, elsewhere)

    def far(tasks):
        return Far()

    assert all("not found by a worker" in row.reason for row in run(fleet, tmp_path / "kept", work_for=far))
    assert any(row.is_fitted for row in run(fleet, tmp_path / "kept"))


def test_a_mistake_of_the_program_is_a_row_too(fleet, tmp_path, monkeypatch):
    def broken(*arguments, **options):
        raise ZeroDivisionError("division by\nzero")

    monkeypatch.setattr(fleet_module, "identify", broken)
    rows = run(fleet, tmp_path / "kept")
    assert {row.reason for row in rows} == {"unexpected ZeroDivisionError: division by zero"}
    assert all(row.start is not None and row.robot == "EMPS" for row in rows), "as far as it is known"


def made_row(k, **others):
    parameters = {"Fv1": Value(value=float(k % 2), low=-1.0, high=2.0, unit="N s/m")}
    start = datetime.fromtimestamp(BEGAN.timestamp() + k, UTC)
    row = {"folder": "a", "file": f"{k}", "robot": "R", "start": start, "verdict": "trust", "parameters": parameters}
    return Row(**{**row, "method": "wls", "status": "solved", "moving_error_percent": 1.0 + k, **others})


def test_charts_are_of_one_folder_and_robot_and_of_fits_that_may_be_used():
    rows = [made_row(k) for k in range(8)]
    rows += [made_row(9, verdict="do not use"), made_row(10, start=None), made_row(11, parameters={}, status="failed")]
    rows += [made_row(k, folder="b") for k in range(3)] + [made_row(k, robot="S") for k in range(2)]
    found = {drift.name: drift for drift in drifts(rows)}
    assert {name: len(drift.rows) for name, drift in found.items()} == {"R, a": 8, "R, b": 3, "S, a": 2}
    error, friction = found["R, a"].charts
    assert (error.name, friction.name) == ("moving error", "Fv1")
    assert error.x.tolist() == [1.0 + k for k in range(8)]
    assert error.outside == [0, 7], "of a steady growth both ends"
    assert found["R, b"].charts[0].limits is None


@pytest.mark.slow
def test_the_command_by_iv_with_its_report(tmp_path, capsys):
    (tmp_path / "arm").mkdir()
    shutil.copy(REPLAY / "scara" / "session.mcap", tmp_path / "arm" / "session.mcap")
    out = tmp_path / "fleet.parquet"
    arguments = ["fleet", str(tmp_path / "arm"), "-o", str(out), "--robot", str(REPLAY / "scara" / "robot.toml")]
    assert main([*arguments, "--method", "iv", "--workers", "1"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("recordings: 1, fitted: 1")
    assert "fits in the charts: 1; control limits need 5" in printed
    (row,) = pyarrow.parquet.read_table(out).to_pylist()
    assert (row["method"], row["status"], row["robot"]) == ("iv", "converged", "SCARA")
    made = read_recording(REPLAY / "scara" / "session.mcap").metadata["created"]
    assert row["start"] == datetime.fromisoformat(made), "its stamps are no dates: when it was made"
    assert main([*arguments, "--cutoff-hz", "20", "--workers", "1"]) == 0
    (row,) = pyarrow.parquet.read_table(out).to_pylist()
    fit = identify(load_signals(REPLAY / "scara" / "session.mcap"), Overrides(cutoff_hz=20.0))
    assert row["error_percent"] == fit.errors[-1].relative_error_percent, "with the settings of the command line"


def test_bad_input_is_one_line(tmp_path, capsys):
    def refused(*arguments):
        status = main(["fleet", *map(str, arguments)])
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        return status, error

    (tmp_path / "empty").mkdir()
    assert refused(tmp_path / "none", "-o", tmp_path / "f.parquet") == (
        1,
        f"robot-identify: {tmp_path / 'none'}: is not a folder: expected a folder of recordings, *.mcap\n",
    )
    status, error = refused(tmp_path / "empty", "-o", tmp_path / "f.parquet")
    assert status == 1
    assert "no recordings: expected files *.mcap" in error
    status, error = refused(tmp_path / "empty", "-o", tmp_path / "none" / "f.parquet")
    assert status == 1
    assert "expected an existing folder" in error
    assert list(tmp_path.iterdir()) == [tmp_path / "empty"], "nothing is made"


def test_where_nothing_can_be_fitted_the_table_is_there_and_the_status_says_so(tmp_path, capsys):
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "notes.mcap").write_text("these are notes")
    out = tmp_path / "fleet.parquet"
    assert main(["fleet", str(tmp_path / "arm"), "-o", str(out), "--rrd", str(tmp_path / "fleet.rrd")]) == 3
    assert "no recording could be fitted" in capsys.readouterr().err
    assert Written(tmp_path / "fleet.rrd").is_complete()
    assert pyarrow.parquet.read_table(out).to_pylist()[0]["status"] == "failed"
