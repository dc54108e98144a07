"""The simulated robot against physics: energy, closed forms, friction that holds,
instants that belong together.
"""

import dataclasses

import msgspec
import numpy as np
import pytest
from conftest import described_chi, robot_named
from loops import free, simulate

from acquisition.robot import robot_from_files
from identification.control import Control, ControlLaw, Reference, default_law
from identification.methods import Iteration, regular_start
from identification.model import (
    DirectModel,
    InverseModel,
    base_parameters,
    direct_model,
    inertias,
    why_not_positive,
)
from identification.regression import Overrides
from identification.results import identify_iv
from identification.simulation import ClosedLoop
from identification.study import Noise, closed_loop, random_reference

RATE = 1000.0


def model_of(name: str, **values: float):
    dynamics = InverseModel(robot_named(name))
    base = base_parameters(dynamics)
    chi = described_chi(dynamics)
    for key, value in values.items():
        chi[[c for c, n in enumerate(dynamics.names) if n.startswith(key)]] = value
    return dynamics, direct_model(dynamics, base.standard_parameters(base.K @ chi))


def still(n: int, seconds: float) -> np.ndarray:
    return np.zeros((round(seconds * RATE), n))


def test_light_wrist_does_not_chatter():
    """Fc h/M = 0.16 rad/s per step on joint 6: explicit friction would reverse its sign
    every step at standstill.
    """
    _, model = model_of("tx40")
    q_ref = still(6, 1.0) + np.array([0.1, -0.3, 0.4, 0.2, 0.5, 0.0])
    loop = default_law(10.0, inertias(model.inertia(q_ref[:1])), RATE)
    assert np.abs(simulate(model, loop, q_ref).ddq[500:]).max() < 0.05


@pytest.mark.parametrize("name", ["tx40", "emps"])
def test_signals_share_one_instant(name):
    """IDM(q, dq, ddq) chi = tau row by row, but for the implicit friction where a joint
    turns round or sticks.
    """
    dynamics, model = model_of(name)
    q_ref = random_reference(dynamics.robot, duration_s=5.0, sample_rate_hz=RATE, seed=2)
    dq_ref = np.gradient(q_ref, 1 / RATE, axis=0)
    ddq_ref = np.gradient(dq_ref, 1 / RATE, axis=0)
    loop = default_law(10.0, inertias(model.inertia(q_ref[::50])), RATE)
    done = simulate(model, loop, Reference(q_ref, dq_ref, ddq_ref), bound=9.0)
    tau = dynamics.regressor(done.q, done.dq, done.ddq) @ described_chi(dynamics)
    along = np.abs(done.dq @ model.directions.T)
    moving = (along > 0.02 * along.max(axis=0)).all(axis=1)
    assert moving.mean() > 0.5
    rms = np.sqrt(np.mean(done.tau**2, axis=0))
    # Viscous friction is taken at the end of the step: h Fv ddq.
    assert (
        np.abs(tau - done.tau)[moving] < 0.02 * rms + 1e-3 * np.abs(done.ddq[moving]).max(axis=0)
    ).all()
    # A shift by one instant is far worse: the test would see it.
    assert np.median(np.abs(tau[5:] - done.tau[:-5])[moving[5:]]) > 3 * np.median(
        np.abs(tau - done.tau)[moving]
    )


def scara_pid(saturation: float) -> tuple[DirectModel, ControlLaw]:
    """The SCARA under a PID, motor 1 limited to `saturation`."""
    _, model = model_of("scara")
    J = inertias(model.inertia(still(2, 0.01)))
    loop = dataclasses.replace(default_law(5.0, J, RATE), gravity="none")
    limits = np.array([saturation, np.inf])
    return model, dataclasses.replace(
        loop, Ki=loop.Kp * 10, position_share=np.ones(2), saturation=limits
    )


def test_saturated_motor_holds_own_integral_only():
    model, loop = scara_pid(saturation=0.5)
    zero, reference = still(2, 0.01), still(2, 0.01) + np.array([1.0, 0.3])
    control = Control(model, loop, zero[0], zero[0])
    control.take(Reference(reference, zero, zero))
    tau = np.array([control.torque(k, zero[0], zero[0]) for k in range(10)])
    np.testing.assert_allclose(tau[:, 0], 0.5)
    np.testing.assert_allclose(np.diff(tau[:, 1]), loop.Ki[1] * 0.3 / RATE, rtol=1e-9)


@pytest.mark.parametrize("structure", ["cascade_p_pi", "pid"])
@pytest.mark.parametrize("estimate", ["exact", "backward_difference", "two_sample_mean"])
def test_multi_instant_steps_match_single(estimate, structure):
    model, loop = scara_pid(saturation=np.inf)
    (w, size), moved = np.array([[9.0, 13.0], [0.6, 0.4]]), []
    for m in (1, 3):
        own = {"velocity_estimate": estimate, "structure": structure, "periods": m}
        t_s = (np.arange(0, 1800, m) + 0.5 * (m - 1))[:, None] / RATE
        path = 1 - np.cos(w * t_s), w * np.sin(w * t_s), w**2 * np.cos(w * t_s)
        slower = dataclasses.replace(loop, period_s=m / RATE, **own)
        done = simulate(
            model, slower, Reference(*(size * x for x in path)), start=2 * [np.zeros(2)]
        )
        moved.append(done.q[300 // m :: 3 // m])
    error = moved[0] - size * (1 - np.cos(w * (t_s[100:] - 1 / RATE)))
    off = np.sqrt(np.mean((moved[1] - moved[0]) ** 2, axis=0) / np.mean(error**2, axis=0))
    # Without the middle of position, speed or integral: from 4e-4 and 9e-3 on.
    assert (off < (5e-3 if structure == "pid" else 1e-4)).all(), off


@pytest.mark.parametrize("estimate", ["exact", "backward_difference", "two_sample_mean"])
def test_reference_segments_match_whole(estimate):
    model, loop = scara_pid(saturation=300.0)
    loop = dataclasses.replace(loop, velocity_estimate=estimate)
    t_s = np.arange(900)[:, None] / RATE
    q_ref = np.hstack([np.sin(9 * t_s), 0.4 * np.cos(13 * t_s)])
    dq_ref = np.gradient(q_ref, 1 / RATE, axis=0)
    reference, bound = Reference(q_ref, dq_ref, np.gradient(dq_ref, 1 / RATE, axis=0)), np.ones(2)
    whole = simulate(model, loop, reference, substeps=2)
    assert whole.reason is None
    assert (np.abs(whole.tau[:, 0]) == 300.0).any()  # saturated now and then
    fastest = np.abs(dq_ref @ model.directions.T).max(axis=0)
    robot = ClosedLoop(model, loop, (q_ref[0], dq_ref[0]), fastest=fastest, substeps=2)
    spans = [slice(0, 1), slice(1, 290), slice(290, 291), slice(291, 900)]
    parts = [
        robot.follow(Reference(*(x[s] for x in (q_ref, dq_ref, reference.ddq))), bound)[0]
        for s in spans
    ]
    for joined, wanted in zip(np.concatenate(parts, axis=1), whole, strict=False):
        np.testing.assert_allclose(joined, wanted, rtol=1e-9, atol=1e-9)
    _, lost = robot.follow(Reference(q_ref[:1] + 9.0, dq_ref[:1], dq_ref[:1]), bound)
    assert "0.900 s" in lost


def test_default_pd_holds_vertical_axis():
    """The PD of 5 Hz alone would let the axis sag by g/w² = 9.9 mm; half of the reference
    would be lost in that.
    """
    text = (
        'name = "lift"\ngravity_m_s2 = [0, 0, -9.81]\n[[joint]]\nname = "z"\ntype = "prismatic"\n'
        "dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }\nrotor_inertia = false\ncoulomb = "
        "false\n"
        '[[motor]]\nname = "m"\neffort_unit = "N"\n[controller]\nbandwidth_hz = '
        "5\n[parameters]\nM1 = 20.0\nFv1 = 50.0\n"
    )
    robot = robot_from_files({"robot.toml": text.encode()}, "lift.toml")
    q_ref = 0.02 * np.sin(np.arange(8000) / 800)[:, None]
    signals = closed_loop(robot, q_ref, RATE, noise=Noise(), seed=1)
    assert np.abs(signals.q - q_ref).max() < 1e-3
    measured = dataclasses.replace(signals, q_ref=None)
    fit = identify_iv(measured, Overrides(), Iteration())
    assert (fit.status, fit.reference, fit.controller) == (
        "converged",
        "surrogate",
        "surrogate",
    )
    assert fit.passes[-1].tracking_percent < 5
    np.testing.assert_allclose(fit.beta, [20.0, 50.0], rtol=0.01)
    # So does a described PD, where the measured position, with the sag in it, stands
    # in for the reference.
    gains = {"position_gain": (20 * 31.4**2,), "velocity_gain": (20 * 50.0,)}
    described = msgspec.structs.replace(
        robot.controller, structure="pd", sample_rate_hz=1000.0, **gains
    )
    signals = closed_loop(
        dataclasses.replace(robot, controller=described), q_ref, RATE, noise=Noise(), seed=1
    )
    assert signals.q.mean() < -5e-3  # it sags
    fit = identify_iv(dataclasses.replace(signals, q_ref=None), Overrides(), Iteration())
    assert (fit.status, fit.passes[-1].tracking_percent < 20) == ("converged", True)


def test_stopped_simulation_reports_reason():
    _, model = model_of("emps")
    loop = dataclasses.replace(
        default_law(1.0, np.array([95.0]), RATE), Kp=np.array([9e8]), Kd=np.array([9e6])
    )
    done = simulate(model, loop, still(1, 0.06), start=(np.array([1e-3]), np.zeros(1)), bound=0.1)
    assert "leaves its reference at joint 1" in done.reason
    assert (np.abs(done.q) < 0.1).all()
    _, model = model_of("emps", Off=500.0)
    done = simulate(model, free(1, RATE), still(1, 1.0), bound=0.1)
    assert "leaves its reference at joint 1" in done.reason
    assert 0 < len(done.q) < RATE
    for name, values in (("scara", {"ZZ2": -0.01}), ("emps", {"M1": -9.0})):
        _, model = model_of(name, Fc=0.0, **values)
        n = len(model.links)
        assert "not positive on the trajectory" in why_not_positive(model.inertia(np.zeros((1, n))))
        reason = simulate(model, free(n, RATE), still(n, 0.1)).reason
        assert reason == "the inertia matrix is not positive definite"


def test_initial_noise_stays_out_of_integral():
    """Begun in motion, off the reference, with 50 rad/s² of a count in its second difference: what
    is held is gravity only.
    """
    model, loop = scara_pid(saturation=np.inf)
    q_ref, off = still(2, 0.1) + 0.3, np.array([0.299, 0.301])
    control = Control(model, loop, off, np.array([1.5, -2.0]))
    control.take(Reference(q_ref, q_ref + 1.0, q_ref + 50.0))
    np.testing.assert_array_equal(control._integral, 0.0)  # the SCARA lies flat
    held = dataclasses.replace(model, offset=np.array([2.0, -0.3]))
    control = Control(held, loop, off, np.array([1.5, -2.0]))
    control.take(Reference(q_ref, q_ref + 1.0, q_ref + 50.0))
    np.testing.assert_allclose(control._integral, [2.0, -0.3])
    # Where the loop adds gravity along the reference itself, the integral holds none of it.
    control = Control(held, dataclasses.replace(loop, gravity="reference"), off, off)
    control.take(Reference(q_ref, q_ref, q_ref))
    np.testing.assert_allclose(control._integral, 0.0, atol=1e-12)


TURN_SLIDE_TURN = 'name = "turn slide turn"\n[controller]\nbandwidth_hz = 5\n' + "".join(
    f'[[joint]]\nname = "{name}"\ntype = "{kind}"\nrotor_inertia = false\n'
    f"dh = {{ alpha_deg = {alpha}, d_m = {d}, theta_deg = 0, r_m = {r} }}\n"
    f'[[motor]]\nname = "{name}"\neffort_unit = "{unit}"\n'
    for name, kind, alpha, d, r, unit in (
        ("shoulder", "revolute", 0, 0, 0, "N m"),
        ("slide", "prismatic", 90, 0, 0, "N"),
        ("turn", "revolute", 90, 0.1, 0.2, "N m"),
    )
)


@pytest.mark.parametrize("mass", [1e-3, 2.0])
def test_representative_robot_has_link_masses(mass):
    """M2R = M2 + M3, and M3 is free to choose: whatever M2R is, M2 must not come out as zero."""
    dynamics = InverseModel(
        robot_from_files({"robot.toml": TURN_SLIDE_TURN.encode()}, "robot.toml")
    )
    base = base_parameters(dynamics)
    assert "M2R" in base.names
    assert "M3" not in base.names
    beta = np.array([{"M2R": mass}.get(name, 0.1) for name in base.names])
    chi = base.standard_parameters(beta)
    np.testing.assert_allclose(base.K @ chi, beta, atol=1e-12)
    assert (np.abs(chi[base.masses[1:]]) > 0.5).all()
    q = np.array([[0.2, 0.1, 0.4]])
    M = direct_model(dynamics, chi).inertia(q)[0]
    rest = dynamics.regressor(q, 0 * q, 0 * q)[0]
    columns = [(dynamics.regressor(q, 0 * q, unit[None])[0] - rest) @ chi for unit in np.eye(3)]
    np.testing.assert_allclose(M, np.stack(columns, axis=1), atol=1e-12)


def test_impossible_parameters_rejected():
    dynamics = InverseModel(robot_named("scara"))
    massless = np.array(
        [{"MX1": 1.0, "ZZ1": 3.0, "ZZ2": 1.0}.get(name, 0.0) for name in dynamics.names]
    )
    assert why_not_positive(direct_model(dynamics, massless).inertia(np.zeros((1, 2)))) is None
    broken = direct_model(dynamics, np.full(dynamics.p, np.nan))
    assert (
        why_not_positive(broken.inertia(np.zeros((1, 2))))
        == "the inertia matrix is not finite on the trajectory"
    )


def test_unit_inertias_doubled_on_coupled_joint():
    dynamics = InverseModel(robot_named("tx40"))
    base = base_parameters(dynamics)
    beta = regular_start(dynamics, base)
    start = {
        name: value for name, value in zip(base.names, np.round(beta, 12), strict=True) if value
    }
    assert start == {"ZZ1R": 1.0, "ZZ2R": 1.0, "Ia3": 1.0, "Ia4": 1.0, "Ia5": 2.0, "Ia6": 1.0}
    J = np.array([5.0, 4.0, 3.0, 0.2, 0.1, 0.01])
    M = direct_model(dynamics, base.standard_parameters(regular_start(dynamics, base, J))).inertia(
        np.zeros((1, 6))
    )[0]
    np.testing.assert_allclose(np.diag(M), J + np.array([0, 0, 0, 0, 0.01, 0]), rtol=1e-9)
    assert (
        why_not_positive(
            direct_model(dynamics, base.standard_parameters(beta)).inertia(np.zeros((1, 6)))
        )
        is None
    )


LAWS_OF_A_LONE_JOINT = {
    "plain": {},
    "integral": {
        "Ki": np.array([900.0]),
        "velocity_estimate": "backward_difference",
        "gravity": "measured",
    },
    "saturated": {"saturation": np.array([1.5]), "velocity_estimate": "two_sample_mean"},
    "cascade": {
        "Ki": np.array([90.0]),
        "saturation": np.array([1.5]),
        "structure": "cascade_p_pi",
        "position_share": np.array([30.0]),
    },
}


@pytest.mark.parametrize("law", LAWS_OF_A_LONE_JOINT)
@pytest.mark.parametrize("friction", ["symmetric", "asymmetric", "none", "load"])
@pytest.mark.parametrize(("kind", "unit"), [("revolute", "N m/A"), ("prismatic", "N/A")])
def test_lone_joint_matches_one_of_several(kind, unit, friction, law):
    """In Python floats as in arrays, to which further friction leads, here of size zero."""
    terms = {"none": "[]", "load": '["viscous", "coulomb", "load"]'}.get(friction, f'"{friction}"')
    text = (
        'name = "lone"\ngravity_m_s2 = [3, 0, -9.81]\n[[joint]]\nname = "x"\ntype = '
        f'"{kind}"\nfriction = {terms}\n'
        "dh = { alpha_deg = 50, d_m = 0.1, theta_deg = 20, r_m = 0.2 }\n"
        f'[[motor]]\nname = "m"\ndrive_gain = 10\ndrive_gain_unit = "{unit}"\nratio = '
        "2\n[controller]\nbandwidth_hz = 5\n"
    )
    dynamics = InverseModel(robot_from_files({"robot.toml": text.encode()}, "lone.toml"))
    values = {"M1": 9.0, "MX1": 0.7, "MY1": -0.4, "ZZ1": 0.9, "Ia1": 0.3, "mu1": 0.2, "Fv1": 3.0}
    values |= {"Fc1": 5.0, "Fvp1": 3.0, "Fvn1": 2.0, "Fcp1": 6.0, "Fcn1": 4.0}
    model = direct_model(dynamics, np.array([values.get(name, 0.0) for name in dynamics.names]))
    model = dataclasses.replace(model, offset=np.ones(1))
    size_0 = {"stribeck": (np.zeros(len(model.directions)), np.ones(len(model.directions)))}
    loop = default_law(5.0, np.full(1, 0.03), RATE)
    own = LAWS_OF_A_LONE_JOINT[law]
    loop = dataclasses.replace(loop, R=np.full((1, 1), 2.0), G=np.full(1, 10.0), **own)
    t_s = np.arange(300)[:, None] / RATE
    q_ref = 0.2 * (1 - np.cos(36 * t_s)) * (t_s < 0.17)
    noise = np.random.default_rng(1).normal(0, 1e-5, q_ref.shape)
    reference = Reference(
        q_ref,
        np.gradient(q_ref, axis=0) * RATE,
        0 * q_ref,
        known_torque=3.0 * (t_s > 0.3),
        feedforward=0.1 * (t_s > 0.6),
        seen=lambda q, k: np.rint((q + noise[k]) / 2e-5) * 2e-5,
    )
    start = np.array([0.01]), np.array([0.2])
    alone, general = (
        simulate(one, loop, reference, start=start, bound=9.0, substeps=2)
        for one in (model, dataclasses.replace(model, shapes={} if friction == "load" else size_0))
    )
    assert alone.reason is general.reason is None
    assert np.ptp(alone.q) > 0.03
    assert (np.abs(alone.tau) == 30.0).any() == ("saturation" in LAWS_OF_A_LONE_JOINT[law])
    same = [
        np.abs(x - y).max() <= 1e-12 * np.abs(y).max()
        for x, y in zip(alone[:4], general[:4], strict=True)
    ]
    assert all(same) == (friction != "load")
