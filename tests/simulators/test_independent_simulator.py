"""The independent simulator against mathematics: closed forms, gradients, another integrator, a
torque of constant slope.
"""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY, described_chi, robot_named
from independent_robots import plant
from independent_simulator import (
    Imperfections,
    Runs,
    described_controller,
    description,
    designed_pd,
    references,
    simulate,
    step,
)
from scipy.integrate import solve_ivp

from identification.model import InverseModel

NAMES = ("emps", "scara", "tx40")


def toml(name: str):
    return REPLAY / name / "robot.toml"


def states(n: int, count: int = 20) -> np.ndarray:
    return np.random.default_rng(n).uniform(-2, 2, size=(3, count, n))


@pytest.mark.parametrize("closed_form", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_inverse_dynamics_match_pinocchio(name, closed_form):
    """The conventions of both are the same: frames, coupled wrist, signs, names of parameters; by
    closed forms and chains.
    """
    dynamics, body = (
        InverseModel(robot_named(name)),
        plant(toml(name), smooth=1e-9, closed_form=closed_form),
    )
    q, dq, ddq = states(body.n)
    expected = dynamics.regressor(q, dq, ddq) @ described_chi(dynamics)
    np.testing.assert_allclose(
        body.inverse(q, dq, ddq), expected, atol=1e-12 * np.abs(expected).max()
    )


def test_tilted_gravity_is_energy_gradient():
    body, q = plant(toml("tx40"), tilt_rad=0.05), states(6)[0]

    def potential(q: np.ndarray) -> np.ndarray:
        _, origin, rotation = body.rigid._frames(q)
        moment = (
            body.rigid.mass[:, None] * origin + (rotation @ body.rigid.moment[..., None])[..., 0]
        )
        return -(moment @ body.rigid.gravity).sum(axis=1)

    torque = body.rigid(q, 0 * q)[1]
    for j, unit in enumerate(1e-5 * np.eye(6)):
        np.testing.assert_allclose(
            torque[:, j], (potential(q + unit) - potential(q - unit)) / 2e-5, atol=1e-7
        )
    assert np.abs(torque[:, 0]).max() > 0.1  # axis 1 is vertical unless the base is tilted


def test_friction_obeys_inverse_model():
    """Root and load friction at both joints: half a step later the inverse model
    gives the torque back.
    """
    body = plant(toml("scara"))
    friction = replace(body.friction, root=np.array([0.6, 0.2]), load=np.array([0.3, 0.2]))
    body = replace(body, friction=friction, offset=np.array([0.1, -0.2]))
    q, v, tau = np.random.default_rng(4).uniform(-2, 2, (3, 50, 2))
    h = 1e-6
    after = step(body, q, v, tau, v, h, 1)
    middle, a = 0.5 * (v + after[1]), (after[1] - v) / h
    moving = (np.abs(v) > 0.2).all(axis=1)
    np.testing.assert_allclose(
        body.inverse(0.5 * (q + after[0]), middle, a)[moving], tau[moving], atol=1e-4
    )
    rigid = body.rigid(q, v)[1] + (body.rigid(q, v)[0] @ a[..., None])[..., 0]
    expected = (
        0.82 * np.sign(v[:, 0]) + 0.04 * v[:, 0] + 0.6 * np.sqrt(np.abs(v[:, 0])) * np.sign(v[:, 0])
    )
    expected += 0.1 + rigid[:, 0] + 0.3 * np.abs(rigid[:, 0]) * np.sign(v[:, 0])
    np.testing.assert_allclose(tau[moving, 0], expected[moving], atol=1e-3)


def integrated(body, runs: Runs, ticks: int, delay_s: float = 0.0) -> np.ndarray:
    """State (2 n,) of the first run after some ticks by DOP853; a command is held for a period,
    from its tick and delay on.
    """
    n, T, state = body.n, 1e-3, np.concatenate([runs.q_true[0, 0], runs.dq_true[0, 0]])

    def slope(_: float, x: np.ndarray, tau: np.ndarray) -> np.ndarray:
        q, v = x[None, :n], x[None, n:]
        M, bias = body.inertia_and_bias(q, v)
        return np.concatenate([v[0], np.linalg.solve(M[0], (tau - bias - body.friction(v))[0])])

    def advanced(state: np.ndarray, span_s: float, command: int) -> np.ndarray:
        tau = runs.effort[0, max(0, command)]
        return solve_ivp(
            slope, (0, span_s), state, method="DOP853", rtol=1e-8, atol=1e-11, args=(tau,)
        ).y[:, -1]

    whole, begun_s = int(delay_s / T), delay_s % T
    for k in range(ticks):
        if begun_s:
            state = advanced(state, begun_s, k - whole - 1)
        state = advanced(state, T - begun_s, k - whole)
    return state


@pytest.mark.parametrize(
    ("name", "delay_s", "closest"),
    [
        ("emps", 0.0, 1e-7),
        ("emps", 1e-3, 1e-7),
        ("scara", 3e-4, 1e-6),
        ("scara", 1.7e-3, 1e-6),
        ("tx40", 0.0, 1e-5),
    ],
)
def test_steps_match_dop853(name, delay_s, closest):
    """The commands of a noisy run through DOP853, friction included, after their delay,
    a part of a period too.
    """
    body, ticks = plant(toml(name), smooth=0.005), 60
    controller = designed_pd(body, 10.0, 1000.0) if name == "tx40" else described_controller(body)
    reference = references(body, range(1), duration_s=0.5, rate_hz=1000.0)
    runs = simulate(
        body, controller, reference, Imperfections(encoder_noise=1e-5, actuation_delay_s=delay_s)
    )
    found = runs.q_true[0, ticks]
    np.testing.assert_allclose(
        found, integrated(body, runs, ticks, delay_s)[: body.n], atol=closest
    )
    without = integrated(body, runs, ticks)[: body.n] if delay_s else runs.q_true[0, 0]
    assert np.abs(found - without).max() > 5 * closest


@pytest.mark.parametrize("recorded", ["command", "mean"])
@pytest.mark.parametrize(("lag", "delay_s"), [(2.25, 0.0), (0, 1.7e-3)])
def test_recorded_delay_of_torque_ramp(recorded, lag, delay_s):
    """Commands of slope one: a record of what acts, at the mean over a period, is
    the instant less the lag.
    """
    cell = Imperfections(recorded=recorded, lag=lag, actuation_delay_s=delay_s)
    body = plant(toml("scara"))
    still = references(body, range(1), duration_s=0.5, rate_hz=1000.0)
    still = replace(still, q=0 * still.q, dq=0 * still.dq, ddq=0 * still.ddq)
    ramp = np.arange(still.q.shape[1])[None, :, None] * 1e-3 + 0 * still.q
    idle = replace(
        described_controller(body), position_gain=np.full(2, 1e-12), velocity_gain=np.zeros(2)
    )
    body = replace(
        body, friction=replace(body.friction, viscous=1e9 * np.eye(2)), offset=np.zeros(2)
    )
    body = replace(body, rigid=lambda q, dq: (np.broadcast_to(1e9 * np.eye(2), (1, 2, 2)), 0 * q))
    runs = simulate(body, idle, still, cell, feedforward=ramp)
    effort = runs.effort[0, 10:, 0]
    acting = ramp[0, 10:, 0] - 0.5e-3 - delay_s  # its mean over the period about the tick
    np.testing.assert_allclose(acting - effort, cell.lag_s(1000.0), atol=1e-9)
    assert runs.signals(description(toml("scara")), 0).effort_timing == recorded
