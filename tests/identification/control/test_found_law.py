"""The control law from a recording: controllers written here, step by step, of a motor that
follows as it pleases.
"""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from conftest import robot_named

import identification.control.found_law as law_module
from acquisition.robot import Controller
from identification.control import FoundLaw, law_of
from identification.data import Signals, load_signals
from identification.regression import Overrides, make_problem

RATE_HZ = 1000.0
STRUCTURES = ("pd", "pd_velocity_feedforward", "cascade_p_p", "cascade_p_pi", "pid")
TRUE = {"kp": 3000.0, "kd": 150.0, "ki": 20_000.0}


def smooth(rng: np.random.Generator, t: np.ndarray, top_hz: float, count: int = 12) -> np.ndarray:
    f, phase = rng.uniform(0.3, top_hz, count), rng.uniform(0, 2 * np.pi, count)
    return 0.1 * np.sum(
        rng.uniform(0.3, 1.0, count) * np.sin(2 * np.pi * np.outer(t, f) + phase) / f, axis=1
    )


def recorded(structure: str, seed: int = 0, *, delay: float = 0.0, noise: float = 0.002) -> Signals:
    """Both motors of a SCARA under a law of this structure; the controller has the reference
    `delay` samples later.
    """
    rng, robot, T = np.random.default_rng(seed), robot_named("scara"), 1 / RATE_HZ
    t = np.arange(round(12 * RATE_HZ)) * T
    q_ref, q, effort = (np.zeros((len(t), 2)) for _ in range(3))
    for j in range(2):
        path, errors = (
            np.random.default_rng(10 * seed + j),
            np.random.default_rng(500 + 10 * seed + j),
        )
        r = smooth(path, t, 3.0)
        given = smooth(np.random.default_rng(10 * seed + j), t - delay * T, 3.0)
        position = given - 0.02 * smooth(errors, t, 6.0) + 2e-6 * rng.standard_normal(len(t))
        e, v = given - position, np.diff(position, prepend=position[0]) / T
        w = np.gradient(given, T)
        kp, kd, ki = TRUE["kp"], TRUE["kd"], TRUE["ki"]
        if structure in ("pd", "cascade_p_p"):
            u = kp * e - kd * v
        elif structure == "pd_velocity_feedforward":
            u = kp * e + kd * (w - v)
        elif structure == "pid":
            u = kp * e + kd * (w - v) + ki * np.cumsum(e) * T
        else:
            wanted = kp / kd * e - v
            u = kd * (wanted + 20.0 * np.cumsum(wanted) * T)
        q_ref[:, j], q[:, j] = r, position
        effort[:, j] = u + noise * u.std() * rng.standard_normal(len(t))
    R = np.array([[1.0, 0.0], [0.6, 1.0]])  # the second motor turns with both joints
    robot = replace(robot, controller=Controller(bandwidth_hz=5.0), R=R)
    motors = np.linalg.inv(R)
    joint = robot.joint_effort(effort)
    return Signals(
        t_s=t, q=q @ motors.T, q_ref=q_ref @ motors.T, effort=joint, sample_rate_hz=RATE_HZ,
        robot=robot, recording="made",
        effort_timing="command",
    )  # fmt: skip


def told(signals: Signals) -> FoundLaw:
    law = law_of(make_problem(signals, Overrides(span="all")))
    assert law is not None
    return law


def gains_of(structure: str) -> list[float]:
    ki = {"pid": TRUE["ki"], "cascade_p_pi": 20.0 * TRUE["kd"]}.get(structure, 0.0)
    return [TRUE["kp"], TRUE["kd"], ki]


@pytest.mark.parametrize(
    ("structure", "delay"),
    [*((x, 0.75) for x in STRUCTURES), *(("pd", x) for x in (-1.0, 3.0)), ("cascade_p_pi", 0.0)],
)
def test_structure_gains_and_delay_estimated(structure, delay):
    law = told(recorded(structure, delay=delay))
    assert law.reason is None
    assert (
        law.law.structure == structure.replace("cascade_p_p", "pd")
        if structure != "cascade_p_pi"
        else structure
    )
    # q of this one is in its integral, and in its error
    within = 0.1 if structure != "cascade_p_pi" else law.delay_half_s.max() * RATE_HZ
    assert law.delay_s * RATE_HZ == pytest.approx(delay, abs=within)
    for found, true in zip(law.gains, gains_of(structure), strict=True):
        assert found == pytest.approx(true, rel=0.015)


def test_intervals_hold():
    inside, widths = [], []
    for seed in range(3):
        for structure in ("pd", "pid"):
            law = told(recorded(structure, seed, noise=0.01))
            true = np.array(gains_of(structure))[:2, None]
            inside.append(np.abs(law.gains[:2] - true) <= law.gains_half[:2])
            widths.append(law.gains_half[:2] / true)
    assert np.mean(inside) >= 0.85
    assert np.median(widths) < 0.01


def test_unknown_structure_not_reported():
    signals = recorded("pd")
    acceleration = np.gradient(np.gradient(signals.q_ref, 1 / RATE_HZ, axis=0), 1 / RATE_HZ, axis=0)
    law = told(
        replace(signals, effort=signals.effort + 30.0 * acceleration * (1 + np.cos(signals.q_ref)))
    )
    assert law.reason is not None
    assert "linear control law" in law.reason


def test_saturated_samples_excluded():
    signals = recorded("pd")
    limit = 0.6 * np.abs(signals.robot.motor_effort(signals.effort)).max(axis=0)
    motors = tuple(
        msgspec.structs.replace(m, saturation=x)
        for m, x in zip(signals.robot.motors, limit.tolist(), strict=True)
    )
    clipped = signals.robot.joint_effort(
        np.clip(signals.robot.motor_effort(signals.effort), -limit, limit)
    )
    named = told(replace(signals, effort=clipped, robot=replace(signals.robot, motors=motors)))
    assert named.gains[0] == pytest.approx(TRUE["kp"], rel=0.02)
    assert told(replace(signals, effort=clipped)).residual_percent.max() > 5.0, "they matter"


def test_real_axis_law_matches_published(emps):
    law = law_of(make_problem(load_signals(emps), Overrides()))
    off = np.abs(law.gains - law.described)[:2]
    assert (law.law.structure, law.reason, law.rival) == ("pd", None, None)
    assert (off < 1e-3 * law.described[:2]).all()
    assert (off < law.gains_half[:2]).all()
    assert (law.gains_half[:2] < 2e-3 * law.described[:2]).all()
    assert abs(law.delay_s[0]) < 1e-5


@pytest.mark.parametrize("times", [np.nan, -1.0])
def test_law_needs_positive_gains(times, monkeypatch):
    """What the simulated robot, the file and [controller] would have:
    refused before any of them.
    """

    def without(*given):
        gains, *others = values(*given)
        return gains * times, *others

    values = law_module._values
    monkeypatch.setattr(law_module, "_values", without)
    law = law_of(make_problem(recorded("pid"), Overrides()))
    assert law.reason == "gains of pid are undetermined, or not positive"
