"""Tables of made-up data whose torques are early, imported: the fit of one finds the lag, and
another is validated with it.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import REPLAY
from independent_simulator import shifted
from planned_pairs import RATE_HZ

from acquisition.commands import main as acquire
from acquisition.robot import load_robot
from identification.commands import main as identify
from identification.study import Noise, closed_loop, random_reference

TOML = REPLAY / "emps" / "robot.toml"
LATE_S = -0.8e-3  # torques are recorded that early, and no table says so
COLUMNS = {"position": ("q", "m"), "reference": ("r", "m"), "effort": ("v", "V")}
EMPS_MAP = '[time]\ncolumn = "t"\n'
EMPS_MAP += "".join(
    f'[{key}]\ncolumns = ["{name}"]\nunit = "{unit}"\n' for key, (name, unit) in COLUMNS.items()
)


def imported(table: np.ndarray, file: Path) -> None:
    """Write a table and import it."""
    np.savetxt(file, table, "%.10g", ",", header="t,q,r,v", comments="")
    files = ["--map", str(file.with_name("map.toml")), "-o", str(file.with_suffix(".mcap"))]
    assert acquire(["import", str(file), "--robot", str(TOML), *files]) == 0


@pytest.fixture(scope="module")
def early(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two recordings of the EMPS imported from tables, and the fit of the first."""
    folder = tmp_path_factory.mktemp("early")
    robot = load_robot(TOML)
    (folder / "map.toml").write_text(EMPS_MAP)
    for seed, name in enumerate(("standard", "pulses"), 1):
        q_ref = random_reference(robot, duration_s=6.0, sample_rate_hz=RATE_HZ, seed=seed)
        done = closed_loop(
            robot, q_ref, RATE_HZ, noise=Noise(encoder_step=1e-6, effort_percent=1.0), seed=seed
        )
        volts = robot.motor_effort(shifted(done.effort[None], 1e3 * LATE_S)[0])
        imported(np.hstack([done.t_s[:, None], done.q, q_ref, volts]), folder / f"{name}.csv")
    assert identify(["fit", str(folder / "standard.mcap"), "--json", str(folder / "fit.json")]) == 0
    return folder


def validated(folder: Path, recording: Path, *options: str) -> dict:
    out = folder / "validated.json"
    assert (
        identify(
            ["validate", str(folder / "fit.json"), str(recording), *options, "--json", str(out)]
        )
        == 0
    )
    return json.loads(out.read_text())


def test_fit_delay_belongs_to_other_table(early):
    lag = json.loads((early / "fit.json").read_text())["lag"]
    assert lag["value_s"] == pytest.approx(LATE_S, abs=1e-4)
    other = early / "pulses.mcap"
    found, stated, none = (
        validated(early, other, *x)
        for x in ([], ["--torque-lag-s", str(lag["value_s"])], ["--torque-lag-s=none"])
    )
    assert found["joints"] == stated["joints"]
    assert found["torque_lag_s"] == lag["value_s"]
    assert not [text for text in found["warnings"] if "lag" in text]
    assert none["relative_error_percent"] > 1.1 * found["relative_error_percent"]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ('effort_timing = "command"\n', "its effort timing is command, that of the fit unknown"),
        ("", "its effort object is N at the joint, that of the fit V at the motor"),
    ],
)
def test_unused_delay_reported(early, tmp_path, changed, said):
    table = np.loadtxt(early / "pulses.csv", delimiter=",", skiprows=1)
    text = changed + EMPS_MAP
    if not changed:
        table[:, 3] *= load_robot(TOML).gain[0]
        text = EMPS_MAP.replace('"V"', '"N"')
    (tmp_path / "map.toml").write_text(text)
    imported(table, tmp_path / "other.csv")
    found = validated(early, tmp_path / "other.mcap")
    lag = f"{1e3 * json.loads((early / 'fit.json').read_text())['lag']['value_s']:.3g} ms"
    told = f"other.mcap: the lag of the fit, {lag}, is not used: {said}; --torque-lag-s states one"
    assert [x for x in found["warnings"] if "lag" in x] == [told]
    stated = validated(early, tmp_path / "other.mcap", "--torque-lag-s", "-0.0008")
    assert not [x for x in stated["warnings"] if "lag" in x]
