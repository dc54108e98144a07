"""Pairs of tables of made-up data, in the shapes of those that others publish: imported, fitted together, validated."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import REPLAY
from friction_models import described, direct_of, model_of
from gain_cases import CATALOGUE, robot_of, with_motors
from independent_simulator import shifted
from planned_pairs import RATE_HZ, planned_motion

from acquisition.commands import main as acquire
from acquisition.robot import Robot, load_robot
from identification.commands import main as identify
from identification.data import RecordingFile, Recordings
from identification.methods import identify as identify_signals
from identification.regression import Overrides
from identification.study import Noise, closed_loop, random_reference

USUAL = ["viscous", "coulomb"]


def arm() -> Robot:
    """The TX40 with efforts in A and known gains, with load friction of its first joints."""
    terms = [[*USUAL, "load"] if j < 3 else USUAL for j in range(6)]
    text = described("tx40", terms, "mu1 = 0.05\nmu2 = 0.08\nmu3 = 0.1\n").files["robot.toml"].decode()
    text = text[: text.index("[bus]")] + text[text.index("[parameters]") :]
    return robot_of(with_motors(text, "N m/A", CATALOGUE["tx40"]))


def moved(robot: Robot, seed: int, duration_s: float = 8.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, dq and currents (N, 6) at 1 kHz along a planned motion, with 2 % noise of the currents and 1 µrad of positions."""
    model, base, beta = model_of(robot)
    q, dq, ddq = planned_motion(robot, seed, duration_s)
    current = robot.motor_effort(direct_of(model, base, beta).torque(q, dq, ddq))
    rng = np.random.default_rng([30, seed])
    current += 0.02 * np.sqrt(np.mean(current**2, axis=0)) * rng.standard_normal(q.shape)
    return q + 1e-6 * rng.standard_normal(q.shape), dq, current


def uneven_log(folder: Path, robot: Robot) -> list[Path]:
    """As the logs of a UR10e: rows every 8 to 13 ms with their times, positions, speeds and currents in one table."""
    heads = [f"{x}_{j}" for x in ("actual_q", "actual_qd", "actual_current") for j in range(6)]
    for name, seed in (("one", 1), ("two", 2)):
        parts = moved(robot, seed)
        rows = np.cumsum(np.random.default_rng(seed).integers(8, 14, 2000))
        rows = rows[rows < len(parts[0])]
        table = np.hstack([rows[:, None] / RATE_HZ, *(x[rows] for x in parts)])
        np.savetxt(folder / f"{name}.csv", table, "%.9g", ",", header=",".join(["timestamp", *heads]), comments="")
    text = '[time]\ncolumn = "timestamp"\nunit = "s"\nresample_hz = 100.0\n'
    kinds = ("position", "rad", "joint"), ("velocity", "rad/s", "joint"), ("effort", "A", "motor")
    for k, (name, unit, side) in enumerate(kinds):
        columns = json.dumps(heads[6 * k : 6 * k + 6])
        text += f'[{name}]\ncolumns = {columns}\nunit = "{unit}"\nside = "{side}"\n'
    (folder / "map.toml").write_text(text)
    return [folder / "one.csv", folder / "two.csv"]


def imported(folder: Path, robot: Path, tables: list[Path]) -> list[str]:
    """The recordings of the tables, each imported by itself."""
    logs = [str(table.with_suffix(".mcap")) for table in tables]
    for table, log in zip(tables, logs, strict=True):
        assert acquire(["import", str(table), "--map", str(folder / "map.toml"), "--robot", str(robot), "-o", log]) == 0
    return logs


def test_two_tables_with_speeds_are_fitted_together(tmp_path):
    robot, out = arm(), tmp_path / "fit.json"
    (tmp_path / "robot.toml").write_bytes(robot.files["robot.toml"])
    logs = imported(tmp_path, tmp_path / "robot.toml", uneven_log(tmp_path, robot))
    assert identify(["fit", *logs, "--workers", "2", "--json", str(out)]) == 0
    fit = json.loads(out.read_text())
    _, base, beta = model_of(robot)
    true = dict(zip(base.names, beta, strict=True))
    off = {p["name"]: 2 * abs(p["value"] - true[p["name"]]) / (p["high"] - p["low"]) for p in fit["parameters"]}
    assert "mu3" in off
    assert max(off.values()) < 2.5
    assert sum(x < 1 for x in off.values()) > 0.9 * len(off)
    assert fit["moving_relative_error_percent"] < 4.5
    assert fit["lag"]["effort_object"] == "A at the motor"


LATE_S = -0.8e-3  # torques are recorded that early, and no table says so
COLUMNS = {"position": ("q", "m"), "reference": ("r", "m"), "effort": ("v", "V")}
EMPS_MAP = '[time]\ncolumn = "t"\n'
EMPS_MAP += "".join(f'[{key}]\ncolumns = ["{name}"]\nunit = "{unit}"\n' for key, (name, unit) in COLUMNS.items())


@pytest.fixture(scope="module")
def early(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two recordings of the EMPS imported from tables, and the fit of the first."""
    folder = tmp_path_factory.mktemp("early")
    robot = load_robot(toml := REPLAY / "emps" / "robot.toml")
    (folder / "map.toml").write_text(EMPS_MAP)
    for seed, name in enumerate(("standard", "pulses"), 1):
        q_ref = random_reference(robot, duration_s=6.0, sample_rate_hz=RATE_HZ, seed=seed)
        done = closed_loop(robot, q_ref, RATE_HZ, noise=Noise(encoder_step=1e-6, effort_percent=1.0), seed=seed)
        volts = robot.motor_effort(shifted(done.effort[None], 1e3 * LATE_S)[0])
        table = np.hstack([done.t_s[:, None], done.q, q_ref, volts])
        np.savetxt(folder / f"{name}.csv", table, "%.10g", ",", header="t,q,r,v", comments="")
    imported(folder, toml, [folder / "standard.csv", folder / "pulses.csv"])
    assert identify(["fit", str(folder / "standard.mcap"), "--json", str(folder / "fit.json")]) == 0
    return folder


def validated(folder: Path, recording: Path, *options: str) -> dict:
    out = folder / "validated.json"
    assert identify(["validate", str(folder / "fit.json"), str(recording), *options, "--json", str(out)]) == 0
    return json.loads(out.read_text())


def test_the_lag_of_a_fit_is_that_of_another_table(early):
    lag = json.loads((early / "fit.json").read_text())["lag"]
    assert lag["value_s"] == pytest.approx(LATE_S, abs=1e-4)
    other = early / "pulses.mcap"
    found, stated, none = (
        validated(early, other, *x) for x in ([], ["--torque-lag-s", str(lag["value_s"])], ["--torque-lag-s=none"])
    )
    assert found["joints"] == stated["joints"]
    assert found["torque_lag_s"] == lag["value_s"]
    assert not [text for text in found["warnings"] if "lag" in text]
    assert none["relative_error_percent"] > 1.1 * found["relative_error_percent"]


def test_two_tables_share_a_lag(early):
    both = Recordings(sources=tuple(RecordingFile.at(early / f"{name}.mcap") for name in ("standard", "pulses")))
    (lag,) = identify_signals(both, Overrides()).lags
    assert set(lag.recordings) == {"standard.mcap", "pulses.mcap"}
    assert lag.value_s == pytest.approx(LATE_S, abs=1e-4)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ('effort_timing = "command"\n', "its effort timing is command, that of the fit unknown"),
        ("", "its effort object is N at the joint, that of the fit V at the motor"),
    ],
)
def test_a_lag_that_is_not_used_is_said(early, tmp_path, changed, said):
    table = np.loadtxt(early / "pulses.csv", delimiter=",", skiprows=1)
    text = changed + EMPS_MAP
    if not changed:
        table[:, 3] *= load_robot(REPLAY / "emps" / "robot.toml").gain[0]
        text = EMPS_MAP.replace('"V"', '"N"')
    np.savetxt(tmp_path / "other.csv", table, "%.10g", ",", header="t,q,r,v", comments="")
    (tmp_path / "map.toml").write_text(text)
    imported(tmp_path, REPLAY / "emps" / "robot.toml", [tmp_path / "other.csv"])
    found = validated(early, tmp_path / "other.mcap")
    lag = f"{1e3 * json.loads((early / 'fit.json').read_text())['lag']['value_s']:.3g} ms"
    told = f"other.mcap: the lag of the fit, {lag}, is not used: {said}; --torque-lag-s states one"
    assert [x for x in found["warnings"] if "lag" in x] == [told]
    stated = validated(early, tmp_path / "other.mcap", "--torque-lag-s", "-0.0008")
    assert not [x for x in stated["warnings"] if "lag" in x]
