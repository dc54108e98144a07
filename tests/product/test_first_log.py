"""From the first own table and a URDF to the report: three commands, none of which refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from independent_simulator import Imperfections, designed_pd, references, simulate
from independent_urdf import FRICTION_OF_TORQUE, arm_of
from urdfs import six_joints

from acquisition.commands import main as acquire
from acquisition.robot import load_robot
from identification.commands import main as identify
from identification.model import InverseModel, base_parameters

RATE_HZ, RATIO, GAINS = 250.0, 101.0, (0.13, 0.13, 0.13, 0.09, 0.09, 0.09)
CELL = Imperfections(encoder_noise=1e-5, torque_noise_percent=1.0, recorded="mean")


def write(path: Path, header: str, separator: str, columns: list[np.ndarray]) -> None:
    np.savetxt(
        path, np.column_stack(columns), "%.9g", separator, header=header, comments="",
    )  # fmt: skip


def test_ur5_rtde_log(tmp_path, monkeypatch, capsys):
    """True base parameters, by an independent inverse model, are in their 95 % intervals."""
    monkeypatch.chdir(tmp_path)
    Path("ur5.urdf").write_text(six_joints())
    body, _ = arm_of(six_joints())
    given = references(body, [1], duration_s=8.0, rate_hz=RATE_HZ)
    runs = simulate(body, designed_pd(body, 6.0, RATE_HZ), given, CELL, seed=1)
    t, q, ref, tau = np.arange(runs.q.shape[1]) / RATE_HZ, runs.q[0], runs.q_ref[0], runs.effort[0]
    kinds = (
        "target_q",
        "target_qd",
        "target_current",
        "actual_q",
        "actual_qd",
        "actual_current",
        "actual_TCP_pose",
    )
    header = " ".join(["timestamp", *(f"{kind}_{j}" for kind in kinds for j in range(6))])
    speed, current = np.gradient(q, 1 / RATE_HZ, axis=0), tau / (RATIO * np.array(GAINS))
    write(
        Path("ur5.csv"),
        header,
        " ",
        [1234.5 + t, ref, speed, 0 * q, q, speed, current, 0.3 + 0 * q],
    )
    options = f"--effort A --ratio {RATIO} --drive-gain {','.join(map(str, GAINS))} -o robot.toml"
    assert identify(["init", "ur5.urdf", *options.split()]) == 0
    assert acquire(["import", "ur5.csv", "--robot", "robot.toml"]) == 0
    out, err = capsys.readouterr()
    assert "ur5.map.toml: proposed; nothing is missing\n" in out
    assert (
        "ur5.mcap: six, 2001 samples at 250 Hz, effort in N m, with reference, with velocity\n"
        in out
    )
    assert err == ""
    assert identify(["fit", "ur5.mcap", "--report", "report.html", "--json", "fit.json"]) in (0, 3)
    assert "six: instrumental variables (IV), converged" in capsys.readouterr().out
    assert Path("report.html").stat().st_size > 10_000
    dynamics, rng = InverseModel(load_robot(Path("robot.toml"))), np.random.default_rng(0)
    base = base_parameters(dynamics)
    q, dq, ddq = (
        rng.uniform(low, high, (100, body.n)) for low, high in ((-2, 2), (0.5, 3), (-9, 9))
    )
    dq *= rng.choice([-1, 1], dq.shape)
    rows = dynamics.regressor(q, dq, ddq)[:, :, base.columns].reshape(-1, base.b)
    true, *_ = np.linalg.lstsq(rows, body.inverse(q, dq, ddq).ravel(), rcond=None)
    np.testing.assert_allclose(rows @ true, body.inverse(q, dq, ddq).ravel(), atol=1e-9)
    found = {one["name"]: one for one in json.loads(Path("fit.json").read_text())["parameters"]}
    for j, (viscous, coulomb) in enumerate(FRICTION_OF_TORQUE[: body.n], 1):
        assert found[f"Fc{j}"]["value"] == pytest.approx(coulomb, rel=0.05)
        assert found[f"Fv{j}"]["value"] == pytest.approx(viscous, rel=0.1)
    assert list(found) == list(base.names)
    outside = [
        name
        for name, x in zip(found, true, strict=True)
        if not found[name]["low"] <= x <= found[name]["high"]
    ]
    assert len(outside) <= 5  # of 52


def small_table(folder: Path, names: str = "time,q_1,q_2,tau_1,tau_2") -> Path:
    t = np.arange(400) * 0.01
    write(folder / "x.csv", names, ",", [t, np.sin(t), np.cos(t), 5 * np.cos(t), 3 * np.sin(t)])
    return folder / "x.csv"


ROW = "dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }\n"
TWO = 'name = "two"\n' + "".join(
    f'[[joint]]\nname = "{j}"\ntype = "revolute"\n{ROW}[[motor]]\nname = "m_{j}"\neffort_unit = "N '
    'm"\n'
    for j in "ab"
)


def test_incomplete_map_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small_table(tmp_path)
    Path("robot.toml").write_text(TWO + "[controller]\n")
    command = ["import", "x.csv", "--robot", "robot.toml", "-o", "log.mcap"]
    assert acquire(command) == 0
    lines = [
        k
        for k, line in enumerate(Path("x.map.toml").read_text().splitlines(), 1)
        if "FILL IN" in line and k > 1
    ]
    assert capsys.readouterr().out.splitlines() == [
        f"x.map.toml: proposed; complete its lines {lines}",
        "next: robot-acquire import x.csv --robot robot.toml -o log.mcap",
    ]
    assert not Path("log.mcap").exists()
    assert acquire(command) == 1
    advice = "Complete these lines and run the same command again."
    assert (
        capsys.readouterr().err
        == f"robot-acquire: x.map.toml: lines = {lines}: they still contain FILL IN. {advice}\n"
    )
    text = Path("x.map.toml").read_text()
    for unit, value in (("unit", "rad"), ("unit", "N m"), ("side", "joint")):
        text = text.replace(f'{unit} = "FILL IN"', f'{unit} = "{value}"', 1)
    Path("x.map.toml").write_text(text)
    assert acquire(command) == 0
    assert capsys.readouterr().out.startswith(
        "log.mcap: two, 400 samples at 100 Hz, effort in N m\n"
    )
    assert Path("x.map.toml").read_text() == text, "a map that is there is used"


def test_without_robot_map_and_init_are_proposed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small_table(tmp_path, "time,state.q[0],state.q[1],state.tau_J[0],state.tau_J[1]")
    assert acquire(["import", "x.csv"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "x.map.toml: proposed; nothing is missing",
        'without a robot.toml: robot-identify init ARM.urdf --effort "N m" --torque-sensor -o '
        "robot.toml",
        "next: robot-acquire import x.csv --robot robot.toml -o x.mcap",
    ]
    Path("x.map.toml").unlink()
    Path("robot.toml").write_text(TWO + "[controller]\n")
    assert acquire(["import", "x.csv", "--robot", "robot.toml"]) == 0
    out = capsys.readouterr().out
    assert (
        "note: joint torque sensors do not measure the rotors: set rotor_inertia = false in " in out
    )
    assert "x.mcap: two, 400 samples at 100 Hz" in out
