"""A position loop whose bandwidth nobody states: filters and simulated loop follow from
where the motion ends.
"""

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from urdfs import packaged_urdf

from acquisition.robot import Controller
from identification.data import Signals
from identification.errors import NoFitError
from identification.export import read_chain, robot_of_chain
from identification.model import InverseModel, base_parameters, known_parameters
from identification.regression import Overrides, make_problem, sample_weights
from identification.results import identify
from identification.view import draw_recording

ROTOR, VISCOUS, COULOMB = (
    np.array(x) for x in ([0.6, 0.6, 0.4, 0.1, 0.1, 0.1], [8, 8, 5, 1, 1, 1], [10, 12, 8, 2, 2, 2])
)
RATE_HZ, DURATION_S, AHEAD_S = 125.0, 30.0, 0.004
NOT_STATED = "controller.bandwidth_hz is not given: the fit uses "


@cache
def recorded(seed: int) -> Signals:
    """A UR5 whose drives feed speed forward: it follows its reference a moment late;
    torque noise of 2 to 4 %.
    """
    path = packaged_urdf("ur5_robot.urdf")
    robot, model = robot_of_chain(read_chain(path)), pin.buildModelFromUrdf(str(path))
    model.armature, data, rng, n = ROTOR, model.createData(), np.random.default_rng(seed), robot.n
    omega, phase = 2 * np.pi * rng.uniform(0.1, 1.0, (5, n)), rng.uniform(0, 6.28, (5, n))
    size, t = (
        3 * rng.uniform(0.1, 0.2, (5, n)) / omega,
        np.arange(round(DURATION_S * RATE_HZ) + 1)[:, None] / RATE_HZ,
    )
    middle = np.clip(-1.2, model.lowerPositionLimit, model.upperPositionLimit) * (np.arange(n) % 2)

    def motion(t: np.ndarray) -> np.ndarray:
        x = np.clip(np.minimum(t, DURATION_S - t) / 2.0, 0.0, 1.0)
        path = sum(s * np.sin(t * w + p) for w, p, s in zip(omega, phase, size, strict=True))
        return middle + x**3 * (10 - 15 * x + 6 * x**2) * path

    h = 1e-4
    q, before, after = (motion(t + by) for by in (0.0, -h, h))
    v, a = (after - before) / (2 * h), (after - 2 * q + before) / h**2
    tau = np.array([pin.rnea(model, data, *x) for x in zip(q, v, a, strict=True)])
    tau += VISCOUS * v + COULOMB * np.tanh(v / 0.005)
    tau += rng.uniform(0.02, 0.04, n) * tau.std(axis=0) * rng.standard_normal(tau.shape)
    joints = tuple(
        msgspec.structs.replace(joint, position_deg=None, speed_deg_s=None)
        for joint in robot.joints
    )
    return Signals(
        t_s=t[:, 0], q=q + 50e-6 * rng.standard_normal(q.shape), q_ref=motion(t + AHEAD_S),
        effort=tau,
        sample_rate_hz=RATE_HZ, robot=replace(robot, joints=joints), recording=f"ur5 {seed}",
        sha256=str(seed),
    )  # fmt: skip


def truth(signals: Signals) -> dict[str, float]:
    dynamics = InverseModel(signals.robot)
    base, chi = (
        base_parameters(dynamics),
        dict(zip(dynamics.names, known_parameters(dynamics), strict=True)),
    )
    for j in range(signals.robot.n):
        chi |= {f"Ia{j + 1}": ROTOR[j], f"Fv{j + 1}": VISCOUS[j], f"Fc{j + 1}": COULOMB[j]}
    return dict(
        zip(base.names, base.K @ np.array([chi[name] for name in dynamics.names]), strict=True)
    )


@pytest.fixture
def ur5() -> Signals:
    return recorded(0)


def test_speed_feedforward_arm_without_bandwidth(ur5):
    fit, true = identify(ur5, Overrides()), truth(ur5)
    values = np.array([true[name] for name in fit.estimate.names])
    assert fit.status == "converged", fit.reason
    assert fit.trust.verdict != "do not use", fit.trust.lines[0].finding
    assert 2.5 < fit.settings.cutoff_hz < 5.0
    assert len(values) == 52
    assert (np.abs(fit.estimate.beta - values) > fit.intervals.half).sum() <= 8
    without = identify(replace(ur5, q_ref=None), Overrides())
    assert without.settings.cutoff_hz == fit.settings.cutoff_hz
    errors = [one.errors[-1].moving_relative_error_percent for one in (without, fit)]
    assert errors[0] == pytest.approx(errors[1], rel=0.1)


def test_filters_and_loop_reported_consistently(ur5):
    problem = make_problem(ur5, Overrides())
    cutoff_hz, loop_hz = problem.settings.cutoff_hz, problem.signals.robot.bandwidth_hz
    assert loop_hz == pytest.approx(2 * cutoff_hz)
    assert problem.settings.decimation == pytest.approx(0.4 * RATE_HZ / cutoff_hz, rel=0.1)
    assert problem.settings.warnings == (
        f"{NOT_STATED}a low-pass at {cutoff_hz:.3g} Hz, and a default PD controller of "
        f"{loop_hz:.3g} Hz if the control law is unknown; "
        f"{ur5.recording} has only noise above {cutoff_hz:.3g} Hz",
    )
    (page,) = draw_recording(ur5, Overrides()).document.sections[:1]
    assert page.warnings == problem.settings.warnings


@pytest.mark.parametrize(
    ("given_hz", "told"),
    [(2.0, "a low-pass at 2 Hz"), (20.0, "a low-pass at 20 Hz"), (0.0, "no low-pass")],
)
def test_given_cutoff_stays_loop_unchanged(ur5, given_hz, told):
    free, given = (make_problem(ur5, Overrides(cutoff_hz=x)) for x in (None, given_hz))
    assert (given.settings.cutoff_hz or 0.0, given.slip_cutoff_hz) == (
        given_hz,
        min(given_hz or np.inf, free.slip_cutoff_hz),
    )
    assert given.signals.robot.bandwidth_hz == free.signals.robot.bandwidth_hz
    assert [text.split(", ")[0] for text in given.settings.warnings] == [NOT_STATED + told]
    stated = replace(ur5, robot=replace(ur5.robot, controller=Controller(bandwidth_hz=3.0)))
    problem = make_problem(stated, Overrides())
    assert (problem.settings.cutoff_hz, problem.signals.robot.bandwidth_hz) == (15.0, 3.0)
    assert problem.settings.warnings == ()


def test_reread_recording_has_same_bandwidth(ur5):
    problem = make_problem(ur5, Overrides())
    again = (light := replace(problem, source=ur5).without_samples).with_samples()
    # and meanwhile nothing holds the samples
    assert (light.signals.q.base, again.signals.robot.bandwidth_hz) == (
        None,
        problem.signals.robot.bandwidth_hz,
    )
    assert again.signals.motion_hz == problem.signals.motion_hz == problem.settings.cutoff_hz


def test_rows_near_reversals_kept(ur5):
    """A sample stands within half a period of twice the motion's end, where its joint reverses."""
    problem = make_problem(replace(ur5, q_ref=None), Overrides())
    moves, beside = sample_weights(problem).moves, ur5.sample_rate_hz / problem.signals.motion_hz
    for own in moves[problem.settings.start : problem.settings.stop].T:
        edges = np.flatnonzero(np.diff(own.astype(int)))
        assert len(edges) > 30
        assert -2 <= np.diff(edges)[own[edges[:-1]]].min() - beside / 2 <= 4


@pytest.mark.parametrize("count", [2, 20, 60])
def test_short_recording_refused(ur5, count):
    few = {name: getattr(ur5, name)[:count] for name in ("t_s", "q", "q_ref", "effort")}
    with pytest.raises(NoFitError):
        make_problem(replace(ur5, **few), Overrides())
