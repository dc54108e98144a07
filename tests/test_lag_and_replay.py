"""Lag of the torque and replay of the described controller, on recordings of the independent simulator and the real EMPS."""

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, robot_named
from independent_robots import plant
from independent_simulator import Imperfections, described_controller, references, simulate

from identification.data.signals import Signals, load_signals
from identification.estimation.diagnostics import autoregression, whitened
from identification.estimation.system import System
from identification.methods.fit import Fit
from identification.methods.idim import identify_ls, validate
from identification.model.inverse import InverseModel
from identification.regression.motion import sampled_at
from identification.regression.problem import make_problem
from identification.regression.settings import Overrides, torque_lag_s
from identification.simulation.control_law import recorded_loop
from identification.study.synthetic import truth
from identification.trust.lines import TrustLine
from identification.trust.replay import replay


@cache
def recorded(name: str, lag: int = 0, noise: float = 0.0, stribeck: float = 0.0, gain_factor: float = 1.0) -> Signals:
    toml = REPLAY / name / "robot.toml"
    body = plant(toml, smooth=0.002)
    body = replace(body, friction=replace(body.friction, stribeck=stribeck))
    cell = Imperfections(lag=lag, encoder_noise=noise, torque_noise_percent=1.0, gain_factor=gain_factor)
    path = references(body, range(1), duration_s=10.0, rate_hz=1000.0)
    return simulate(body, described_controller(body), path, cell).signals(robot_named(name), 0)


@cache
def fitted(signals: Signals, *, trust: bool = True, torque_lag_s: float | str | None = None) -> Fit:
    return identify_ls(signals, Overrides(torque_lag_s=torque_lag_s), trust=trust)


def line(fit: Fit, test: str) -> TrustLine:
    return next(found for found in fit.trust.lines if found.test == test)


def with_controller(signals: Signals, **keys: object) -> Signals:
    robot = signals.robot
    return replace(signals, robot=replace(robot, controller=msgspec.structs.replace(robot.controller, **keys)))


# Lag


@pytest.mark.parametrize("lag", [0, 1, 3])
@pytest.mark.parametrize("name", ["emps", "scara"])
def test_a_lag_is_found_about_half_a_period_early(name, lag):
    found = line(fitted(recorded(name, lag=lag)), "lag")
    assert found.level == ("caution" if lag else "ok")
    for figure in found.figures:
        assert figure.expected == -0.5
        assert figure.value - figure.expected == pytest.approx(lag, abs=0.15)
        assert figure.half_width < 0.25


def test_the_worst_joint_is_named():
    signals = recorded("scara")
    late = np.array(signals.effort)
    late[2:, 1] = late[:-2, 1]
    found = line(fitted(replace(signals, effort=late)), "lag")
    assert found.level == "caution"
    assert found.text.startswith("joint elbow: torque 1.")
    assert found.value == pytest.approx(1.5, abs=0.15)
    assert found.figures[0].value == pytest.approx(-0.5, abs=0.2)


@pytest.mark.parametrize("lag", [0, 1])
def test_noise_that_is_fed_back_does_not_pass_for_a_lag(lag):
    found = line(fitted(recorded("emps", lag=lag, noise=2e-5)), "lag")
    assert found.value == pytest.approx(lag - 0.5, abs=2.5 * found.figures[0].half_width)
    assert found.figures[0].half_width < 0.8
    assert found.level in (("ok", "cannot tell") if not lag else ("caution", "cannot tell"))


def test_friction_that_the_model_lacks_does_not_pass_for_a_lag():
    assert line(fitted(recorded("emps", stribeck=0.5)), "lag").level != "caution"


def test_the_mean_over_the_period_is_expected_at_zero():
    signals = recorded("scara")
    mean = np.array(signals.effort)
    mean[1:] = 0.5 * (mean[1:] + mean[:-1])
    found = line(fitted(replace(signals, effort=mean, effort_timing="mean")), "lag")
    assert found.level == "ok"
    assert [figure.expected for figure in found.figures] == [0.0, 0.0]
    timings = [load_signals(REPLAY / name / "session.mcap").effort_timing for name in ("scara", "tx40")]
    assert timings == ["drive", "drive"]
    found = line(fitted(load_signals(REPLAY / "scara" / "session.mcap")), "replay")
    assert (found.level, found.caps) == ("not made", True)


def test_a_known_lag_is_corrected_and_the_test_counts_from_it():
    late, right = recorded("emps", lag=3), recorded("emps")
    fit = fitted(late, torque_lag_s=0.003)
    assert fit.settings.torque_lag_s == 0.003
    np.testing.assert_allclose(fit.beta, fitted(right).beta, rtol=0.01)
    assert np.abs(fitted(late).beta / fitted(right).beta - 1).max() > 0.03
    found = line(fitted(late, torque_lag_s=0.0025), "lag")
    assert found.figures[0].expected == pytest.approx(2.5)
    assert found.level == "ok"
    stated = msgspec.structs.replace(late.robot.identification, torque_lag_s=0.003)
    by_description = identify_ls(replace(late, robot=replace(late.robot, identification=stated)), Overrides())
    np.testing.assert_array_equal(by_description.beta, fit.beta)
    errors = [validate(late, Overrides(torque_lag_s=s), lambda base: fit.beta)[1][-1] for s in (0.003, 0.0)]
    assert errors[0].relative_error_percent < 0.8 * errors[1].relative_error_percent


@pytest.mark.parametrize(
    ("timing", "rate_hz", "stated", "option", "corrected", "expected"),
    [
        ("command", 1000.0, None, None, -0.5e-3, -0.5e-3),
        ("command", 500.0, None, None, -1e-3, -1e-3),
        ("mean", 1000.0, None, None, 0.0, 0.0),
        ("drive", 1000.0, None, None, 0.0, 0.0),
        ("measured", 1000.0, None, None, 0.0, 0.0),
        ("command", None, None, None, 0.0, 0.0),
        ("command", 1000.0, "none", None, 0.0, -0.5e-3),
        ("command", 1000.0, 2e-3, None, 2e-3, 2e-3),
        ("command", 1000.0, 2e-3, "none", 0.0, -0.5e-3),
        ("command", 1000.0, "none", 0.0, 0.0, 0.0),
    ],
)
def test_which_lag_is_corrected_and_which_is_expected(timing, rate_hz, stated, option, corrected, expected):
    signals = with_controller(replace(recorded("scara"), effort_timing=timing), sample_rate_hz=rate_hz)
    own = msgspec.structs.replace(signals.robot.identification, torque_lag_s=stated)
    signals = replace(signals, robot=replace(signals.robot, identification=own))
    assert torque_lag_s(signals, Overrides(torque_lag_s=option)) == (corrected, expected)


def test_a_held_command_is_shifted_by_half_its_period():
    """As recorded, half a period early, the parameters are further off than noise takes them."""
    signals = recorded("scara")
    true = truth(InverseModel(signals.robot), fitted(signals, trust=False).base)
    error = {
        lag: np.linalg.norm(fitted(signals, trust=False, torque_lag_s=lag).beta - true)
        for lag in (None, "none", -0.5e-3)
    }
    assert error[None] == error[-0.5e-3]
    assert error[None] < 0.5 * error["none"]


def test_the_shift_is_that_of_a_sine_and_ends_are_cut():
    t = np.arange(2000.0)
    x = np.sin(0.05 * t)[:, None]
    np.testing.assert_allclose(sampled_at(t[:-10] + 0.3, x)[:, 0], np.sin(0.05 * (t[:-10] + 0.3)), atol=1e-6)
    signals = recorded("scara")
    N = len(signals.q)
    for lag_s in (0.9, -0.9):
        settings = make_problem(signals, Overrides(torque_lag_s=lag_s, span="all")).settings
        assert (settings.start >= 900) == (lag_s < 0)
        assert (settings.stop <= N - 900) == (lag_s > 0)


def test_without_instruments_the_line_says_how_to_make_it():
    found = line(fitted(recorded("scara"), trust=False), "lag")
    assert (found.level, found.caps) == ("not made", False)
    assert "--trust" in found.text
    bare = replace(recorded("scara"), q_ref=None)
    found = line(identify_ls(bare, Overrides(), trust=True), "lag")
    assert (found.level, found.caps) == ("not made", True)
    assert "no reference" in found.text
    np.testing.assert_array_equal(fitted(recorded("scara")).beta, fitted(recorded("scara"), trust=False).beta)


def test_an_autoregression_is_found_and_taken_out():
    rng = np.random.default_rng(1)
    x, e = np.zeros(20_000), rng.standard_normal(20_000)
    for k in range(2, len(x)):
        x[k] = 1.2 * x[k - 1] - 0.5 * x[k - 2] + e[k]
    np.testing.assert_allclose(autoregression(x, 2), [1.2, -0.5], atol=0.03)
    system = System.whole(x[:, None], x, np.zeros(len(x), dtype=int), ("a",))
    white, Z = whitened(system, 2 * x[:, None], x, 2)
    assert white.Y[2:] == pytest.approx(e[2:], abs=0.5)
    np.testing.assert_array_equal(Z, 2 * white.W)
    assert white.used[:2].sum() == 0


# Replay


def replayed(signals: Signals) -> TrustLine:
    return line(fitted(signals, trust=False), "replay")


@pytest.mark.parametrize("name", ["emps", "scara"])
def test_the_right_controller_is_confirmed_and_faults_are_named(name):
    signals = recorded(name)
    right = replayed(signals)
    assert right.level == "ok"
    assert right.value == pytest.approx(1.0, abs=1e-3)
    scaled = replayed(replace(signals, effort=1.1 * signals.effort))
    assert (scaled.level, scaled.value) == ("caution", pytest.approx(1.1, abs=1e-3))
    sign = np.ones(signals.robot.n)
    sign[-1] = -1
    wrong = replayed(replace(signals, effort=signals.effort * sign))
    assert (wrong.level, wrong.value) == ("do not use", pytest.approx(-1.0, abs=1e-3))
    assert f"joint {signals.robot.joints[-1].name}:" in wrong.text
    assert signals.q_ref is not None
    ratio = replayed(replace(signals, q=1.05 * signals.q, q_ref=1.05 * signals.q_ref, effort=signals.effort / 1.05))
    assert (ratio.level, ratio.value) == ("caution", pytest.approx(1 / 1.05**2, abs=1e-3))
    weak = replayed(recorded(name, gain_factor=2.0))
    assert (weak.level, weak.value) == ("caution", pytest.approx(2.0, abs=2e-3))


def test_a_rate_one_percent_wrong_shows_where_a_speed_is_fed_back():
    signals = recorded("emps")
    found = replayed(replace(signals, sample_rate_hz=1010.0, t_s=signals.t_s / 1.01))
    assert found.level == "caution"


def test_an_integral_is_replayed_and_missed_where_it_is_not_described():
    toml = REPLAY / "scara" / "robot.toml"
    body = plant(toml, smooth=0.002)
    c = described_controller(body)
    c = replace(
        c, structure="cascade_p_pi", position_gain=c.position_gain / c.velocity_gain, integral_gain=np.full(2, 20.0)
    )
    path = references(body, range(1), duration_s=5.0, rate_hz=1000.0)
    runs = simulate(body, c, path, Imperfections(torque_noise_percent=1.0))
    signals = with_controller(
        runs.signals(robot_named("scara"), 0),
        structure="cascade_p_pi",
        position_gain=tuple(c.position_gain),
        integral_gain=(20.0, 20.0),
    )
    assert replayed(signals).level == "ok"
    assert replayed(with_controller(signals, structure="cascade_p_p", integral_gain=None)).level == "caution"


@pytest.mark.parametrize("lag", [0, 3])
def test_a_replay_tells_a_lag_of_noisy_commands(lag):
    signals = recorded("emps", lag=lag, noise=2e-5)
    found = replay(make_problem(signals, Overrides()), recorded_loop(signals.robot))
    assert found.lag[0] == pytest.approx(lag, abs=0.1)
    assert found.error_percent[0] < 1.1
    corrected = replay(make_problem(signals, Overrides(torque_lag_s=0.002)), recorded_loop(signals.robot))
    assert corrected.lag[0] == pytest.approx(found.lag[0], abs=0.02), "of the effort as it was recorded"


def test_a_replay_that_cannot_be_made_caps_the_verdict():
    signals = recorded("scara")
    bare = with_controller(
        signals, structure=None, sample_rate_hz=None, position_gain=None, velocity_gain=None, velocity_estimate=None
    )
    part = with_controller(signals, velocity_gain=None)
    torque = with_controller(signals, structure="computed_torque")
    for one, why in (
        (replace(signals, q_ref=None), "no reference"),
        (bare, "describes no control law"),
        (part, "not all of one"),
        (torque, "own model"),
    ):
        fit = identify_ls(one, Overrides())
        found = line(fit, "replay")
        assert (found.level, found.caps) == ("not made", True)
        assert why in found.text
        assert fit.trust.verdict != "trust"


def test_the_real_emps(emps):
    """Controller confirmed. Away from reversals the volts are 0.8 ms early; half a period, 0.5 ms, is that of a held command.

    Rows beside reversals, where friction rises smoothly in place of a step, would add 0.3 ms (-0.50 with them); rows above 20,
    30 % of the peak speed agree on -0.80.
    """
    fit = identify_ls(load_signals(emps), Overrides(), trust=True)
    found = line(fit, "replay")
    assert found.level == "ok"
    assert found.value == pytest.approx(1.0, abs=1e-3)
    lag = line(fit, "lag")
    assert lag.value == pytest.approx(-0.8, abs=0.1)
