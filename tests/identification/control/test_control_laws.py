"""Each control law against its sampled loop written out by hand, with the exact matrix
exponential of the plant.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY
from loops import free, modelled, simulate
from scipy.linalg import expm

from acquisition.robot import load_robot, robot_from_files
from identification.control import Control, ControlLaw, Reference, described_law
from identification.errors import BadInputError
from identification.model import InverseModel, described_parameters, direct_model, inertias

MASS, VISCOUS, GAIN, RATIO, T = 20.0, 5.0, 10.0, 2.0, 1e-3
TICKS = 400
LAWS = {
    "pd": (500.0, 25.0, 0.0),
    "pd_velocity_feedforward": (500.0, 25.0, 0.0),
    "cascade_p_p": (20.0, 25.0, 0.0),
    "cascade_p_pi": (20.0, 25.0, 10.0),
    "pid": (500.0, 25.0, 2000.0),
    "computed_torque": (900.0, 50.0, 0.0),
}
ESTIMATES = ("exact", "backward_difference", "two_sample_mean")


def axis(structure: str, estimate: str, saturation: float):
    """A mass on a rail, driven through a ratio of 2 by a motor of 10 N/A."""
    kp, kd, ki = LAWS[structure]
    integral = f"integral_gain = [{ki}]\n" if ki else ""
    limit = f"saturation = {saturation}\n" if np.isfinite(saturation) else ""
    text = (
        'name = "axis"\n[[joint]]\nname = "x"\ntype = "prismatic"\n'
        "dh = { alpha_deg = 90, d_m = 0, theta_deg = 0, r_m = 0 }\nrotor_inertia = false\ncoulomb "
        "= false\n"
        f'[[motor]]\nname = "m"\ndrive_gain = {GAIN}\ndrive_gain_unit = "N/A"\nratio = '
        f"{RATIO}\n{limit}"
        f'[controller]\nbandwidth_hz = 5\nstructure = "{structure}"\nsample_rate_hz = {1 / T}\n'
        f"position_gain = [{kp}]\nvelocity_gain = [{kd}]\n{integral}velocity_estimate = "
        f'"{estimate}"\n'
        f"[parameters]\nM1 = {MASS}\nFv1 = {VISCOUS}\n"
    )
    return robot_from_files({"robot.toml": text.encode()}, "axis.toml")


REST = (np.zeros(1), np.zeros(1))


def by_hand(
    structure: str, estimate: str, path: np.ndarray, saturation: float, ahead=None, force=None
):
    """Position and motor effort of the sampled loop along the reference path: position, speed,
    acceleration (3, TICKS).

    `ahead` (TICKS,) is added to the motor's effort, `force` (TICKS,) to that on the mass.
    """
    ahead, force = (np.zeros(path.shape[1]) if x is None else x for x in (ahead, force))
    kp, kd, ki = LAWS[structure]
    held = expm(T * np.array([[0, 1, 0], [0, -VISCOUS / MASS, RATIO * GAIN / MASS], [0, 0, 0]]))
    q = v = before = earlier = integral = 0.0
    positions, efforts = [], []
    if structure in ("cascade_p_pi", "pid"):  # it has held the mass at rest before
        integral = -(ahead[0] + force[0] / (RATIO * GAIN)) / (
            ki * kd if structure == "cascade_p_pi" else ki
        )
    for (r, dr, ddr), fed, push in zip(path.T, ahead, force, strict=True):
        dq = {
            "exact": v,
            "backward_difference": (q - before) / T,
            "two_sample_mean": (q - earlier) / (2 * T),
        }[estimate]
        before, earlier = q, before
        e, de, speed = RATIO * (r - q), RATIO * (dr - dq), RATIO * dq
        kept = integral
        if structure == "pd":
            u = kp * e - kd * speed
        elif structure == "pd_velocity_feedforward":
            u = kp * e + kd * de
        elif structure == "cascade_p_p":
            u = kd * (kp * e - speed)
        elif structure == "cascade_p_pi":
            integral += T * (kp * e - speed)
            u = kd * ((kp * e - speed) + ki * integral)
        elif structure == "pid":
            integral += T * e
            u = kp * e + kd * de + ki * integral
        else:
            u = (MASS * (ddr + (kp * e + kd * de) / RATIO) + VISCOUS * v) / (GAIN * RATIO)
        u += fed
        if abs(u) > saturation:
            u, integral = np.sign(u) * saturation, kept
        positions.append(q)
        efforts.append(u)
        q, v, _ = held @ [q, v, u + push / (RATIO * GAIN)]
    return np.array(positions), np.array(efforts)


def path_of(kind: str) -> np.ndarray:
    """A step of 10 mm, or a sine with its derivatives; the first instant is
    at rest at zero in both.
    """
    t, w = T * np.arange(TICKS), 2 * np.pi * 3
    if kind == "step":
        return np.stack([np.where(t > 0, 0.01, 0.0), 0 * t, 0 * t])
    return 0.01 * np.stack([1 - np.cos(w * t), w * np.sin(w * t), w**2 * np.cos(w * t)])


@pytest.mark.parametrize(
    ("kind", "saturation"), [("step", np.inf), ("step", 3.0), ("sine", np.inf), ("sine", 1e6)]
)
@pytest.mark.parametrize("estimate", ESTIMATES)
@pytest.mark.parametrize("structure", LAWS)
def test_each_law_matches_sampled_loop(structure, estimate, kind, saturation):
    robot = axis(structure, estimate, saturation)
    (*_, model), path = modelled(robot), path_of(kind)
    done = simulate(
        model, described_law(robot), Reference(*path[..., None]), start=REST, substeps=4
    )
    q, effort = by_hand(structure, estimate, path, saturation)
    assert (np.abs(effort) > 0.999 * saturation).any() == (saturation == 3.0)
    assert np.abs(q).max() > 5e-3
    np.testing.assert_allclose(done.q[::4, 0], q, atol=2e-7)
    np.testing.assert_allclose(
        done.tau[::4, 0], GAIN * RATIO * effort, atol=1e-3 * np.abs(GAIN * RATIO * effort).max()
    )


@pytest.mark.parametrize("saturation", [np.inf, 3.0])
@pytest.mark.parametrize("structure", LAWS)
def test_external_torque_and_feedforward_in_loop(structure, saturation):
    robot = axis(structure, "exact", saturation)
    (*_, model), path = modelled(robot), path_of("sine")
    k = np.arange(TICKS)
    ahead, force = 1.5 + 2.0 * ((k > 100) & (k < 160)), 8.0 - 20.0 * (k > 250)
    known = {"feedforward": ahead[:, None], "known_torque": force[:, None]}
    done = simulate(
        model, described_law(robot), Reference(*path[..., None], **known), start=REST, substeps=4
    )
    q, effort = by_hand(structure, "exact", path, saturation, ahead, force)
    np.testing.assert_allclose(done.q[::4, 0], q, atol=5e-7)
    np.testing.assert_allclose(
        done.tau[::4, 0], GAIN * RATIO * effort, atol=1e-3 * np.abs(GAIN * RATIO * effort).max()
    )


@pytest.mark.parametrize("structure", LAWS)
def test_gain_update_leaves_motion_unchanged(structure):
    """Twice the mass and friction under twice the gains and twice the limit: the same
    motion, saturated or not.
    """
    robot = axis(structure, "backward_difference", 3.0)
    dynamics, base, _ = modelled(robot)
    moved = []
    for factor in (1.0, 2.0):
        model = direct_model(
            dynamics, base.standard_parameters(factor * described_parameters(dynamics, base))
        )
        loop = described_law(robot).scaled(np.array([factor]))
        moved.append(simulate(model, loop, path_of("step")[0][:, None].copy()))
    assert np.abs(moved[0].tau).max() == pytest.approx(3.0 * GAIN * RATIO)
    np.testing.assert_allclose(moved[1].q, moved[0].q, atol=1e-12)
    np.testing.assert_allclose(moved[1].tau, 2 * moved[0].tau, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("way", [1, -1])
def test_directional_viscous_decay(way):
    """M dv/dt = -Fv v - Fc of the side it moves to: v = (v0 + Fc/Fv) exp(-Fv t/M) - Fc/Fv."""
    dynamics = InverseModel(load_robot(REPLAY / "emps" / "robot_published_asymmetric.toml"))
    values = {"M1": 95.0, "Fvp1": 160.0, "Fcp1": 15.0, "Fvn1": 240.0, "Fcn1": 25.0}
    chi = np.array([values.get(name, 0.0) for name in dynamics.names])
    Fv, Fc = (160.0, 15.0) if way > 0 else (240.0, 25.0)
    model = direct_model(dynamics, chi)
    zero, speed = np.zeros((1, 1)), np.full((1, 1), way * 0.2)
    for torque in (
        model.torque(zero, speed, zero),
        dynamics.regressor(zero, speed, zero)[0, 0] @ chi,
    ):
        assert torque == pytest.approx(way * (Fv * 0.2 + Fc))
    start = (np.zeros(1), np.array([way * 0.5]))
    done = simulate(model, free(1, 1 / T), np.zeros((TICKS, 1)), start=start, substeps=4)
    t = T / 4 * np.arange(4 * TICKS)
    np.testing.assert_allclose(
        way * done.dq[:, 0], (0.5 + Fc / Fv) * np.exp(-Fv / 95 * t) - Fc / Fv, atol=1e-4
    )


def test_coupled_gains_act_at_motors():
    R, e = np.array([[2.0, 0.0], [3.0, -4.0]]), np.array([0.01, 0.02])
    model = direct_model(
        dynamics := InverseModel(load_robot(REPLAY / "scara" / "robot.toml")),
        np.array([{"ZZ1": 3.0, "ZZ2": 0.1}.get(name, 0.0) for name in dynamics.names]),
    )
    loop = ControlLaw(
        kind="described", structure="pd", period_s=T, R=R,
        G=np.array([10.0, 5.0]), Kp=np.array([7.0, 11.0]), Kd=np.zeros(2),
        Ki=np.zeros(2),
        position_share=np.ones(2), saturation=np.full(2, np.inf),
        velocity_estimate="exact",
    )  # fmt: skip
    m1, m2 = 10.0 * 7.0 * 2.0 * 0.01, 5.0 * 11.0 * (3.0 * 0.01 - 4.0 * 0.02)
    for estimate in ("exact", "backward_difference"):  # the two ways through the law
        law = replace(loop, velocity_estimate=estimate)
        done = simulate(model, law, np.tile(e, (2, 1)), start=(np.zeros(2), np.zeros(2)))
        np.testing.assert_allclose(done.tau[0], [2.0 * m1 + 3.0 * m2, -4.0 * m2], rtol=1e-12)
    # The joints' inertias that make these gains oscillators of 5 Hz: w² J = Rᵀ G
    # Kp R on the diagonal.
    w2 = (2 * np.pi * 5.0) ** 2
    np.testing.assert_allclose(loop.inertias(5.0), np.array([4 * 70.0 + 9 * 55.0, 16 * 55.0]) / w2)
    np.testing.assert_array_equal(replace(loop, structure="computed_torque").inertias(5.0), 1.0)


@pytest.mark.parametrize("estimate", ESTIMATES)
def test_loop_started_on_reference_needs_no_effort(estimate):
    robot = axis("pd_velocity_feedforward", estimate, np.inf)
    dynamics = InverseModel(robot)
    model = direct_model(
        dynamics, np.array([{"M1": MASS}.get(name, 0.0) for name in dynamics.names])
    )
    path, speed = 0.1 + 0.2 * T * np.arange(20)[:, None], np.full((20, 1), 0.2)
    done = simulate(model, described_law(robot), Reference(path, speed, 0 * speed))
    np.testing.assert_allclose(done.tau, 0.0, atol=1e-9)
    np.testing.assert_allclose(done.q, path, atol=1e-12)


@pytest.mark.parametrize(("limit", "effort"), [(np.inf, 0.4), (0.3, 0.3)])
def test_integral_starts_within_limit(limit, effort):
    """8 N to hold at 20 N/A take 0.4 A; of a limit of 0.3 A no more than
    that is in the integral.
    """
    robot = axis("pid", "exact", limit)
    (*_, model), loop, zero = modelled(robot), described_law(robot), np.zeros((2, 1))
    control = Control(replace(model, offset=np.array([8.0])), loop, zero[0], zero[0])
    control.take(Reference(zero, zero, zero))
    assert control._integral == pytest.approx(effort)
    assert control.torque(0, zero[0], zero[0]) == pytest.approx(effort * GAIN * RATIO)


@pytest.mark.parametrize(
    ("force", "more", "moves"),
    [
        (14.0, 0.0, False),
        (16.0, 0.0, True),
        (-24.0, 0.0, False),
        (-26.0, 0.0, True),
        (16.0, 2.0, False),
        (18.0, 2.0, True),
    ],
)
def test_directional_friction_holds_by_direction(force, more, moves):
    """15 N hold against a push in the positive direction, 25 N against one in the negative
    direction, and with Stribeck friction `more`.
    """
    dynamics = InverseModel(load_robot(REPLAY / "emps" / "robot_published_asymmetric.toml"))
    values = {"M1": 95.0, "Fcp1": 15.0, "Fcn1": 25.0}
    model = direct_model(dynamics, np.array([values.get(name, 0.0) for name in dynamics.names]))
    shapes = {"stribeck": (np.array([more]), np.array([0.1]))} if more else {}
    pushed = replace(model, offset=np.array([-force]), shapes=shapes)
    zero = np.zeros((TICKS, 1))
    done = simulate(pushed, free(1, 1 / T), Reference(zero, zero + 0.1, zero), start=REST)
    creep = 1e-4 * (force + 5) / (20 + more)  # in proportion, up to a thousandth of the speed
    assert moves or done.dq[-1, 0] == pytest.approx(creep, rel=1e-2)
    assert (abs(done.dq[-1, 0]) > 2e-3) == moves


def test_joint_inertia_is_largest_along_path():
    """SCARA, elbow straight and folded: ZZ1R + ZZ2 ± 2 L MX2 at the shoulder, ZZ2 at the elbow."""
    *_, model = modelled(load_robot(REPLAY / "scara" / "robot.toml"))
    poses = np.array([[0.3, np.pi], [0.1, 0.0], [0.2, np.pi]])
    np.testing.assert_allclose(
        inertias(model.inertia(poses)), [3.45 + 0.061 + 2 * 0.123, 0.061], rtol=1e-12
    )


def test_incomplete_controller_names_missing_keys():
    text = axis("pid", "exact", np.inf).files["robot.toml"].decode()
    robot = robot_from_files(
        {"robot.toml": re.sub("(velocity|integral)_gain = .*", "", text).encode()}, "axis.toml"
    )
    with pytest.raises(
        BadInputError, match=r"velocity_gain, integral_gain is missing\. Give all of structure"
    ):
        described_law(robot)


@pytest.mark.parametrize(
    ("Kd", "structure", "periods"),
    [
        ((1.0, 1.0), "pd", 4),  # as many as leave 1 kHz
        # speed loops of 1200/s, and of 300/s and 1200/s (eigenvalues by hand): 0.6 of a step
        ((2400.0, 1.0), "pd", 2),
        ((600.0, 600.0), "pd", 2),
        ((9e3, 1.0), "pd", 1),
        ((1.0, 1.0), "computed_torque", 1),
    ],
)
def test_substeps_follow_fastest_speed_loop(Kd, structure, periods):
    R = np.array([[1.0, 0.0], [0.0, -1.0]])
    loop = replace(free(2, 4000.0), R=R, Kd=np.array(Kd), G=np.ones(2), structure=structure)
    slower = loop.slower(np.stack([np.diag([2.0, 2.0]), np.diag([3.0, 0.5])]), 1000.0)
    assert (slower.periods, slower.period_s) == (periods, pytest.approx(periods / 4000))
