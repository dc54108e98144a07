"""A position loop whose bandwidth nobody states: found in the tracking, or a cut-off is proposed."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from independent_robots import plant
from independent_simulator import Imperfections, described_controller, description, designed_pd, references, simulate

from acquisition.robot import Controller
from identification.data import Signals, load_signals
from identification.errors import IdentificationError
from identification.methods import identify_ls
from identification.regression import Overrides, make_problem, make_settings
from identification.regression.bandwidth import tracking_bandwidth


def simulated(name: str) -> Signals:
    """Without the bandwidth, nor the control law."""
    toml = REPLAY / name / "robot.toml"
    body = plant(toml)
    controller = designed_pd(body, 10.0, 500.0) if name == "tx40" else described_controller(body)
    cell = Imperfections(encoder_noise=3e-6, torque_noise_percent=3.0)
    runs = simulate(body, controller, references(body, [0], duration_s=8.0, rate_hz=controller.rate_hz), cell)
    return unstated(runs.signals(description(toml), 0))


def unstated(signals: Signals) -> Signals:
    return replace(signals, robot=replace(signals.robot, controller=Controller()))


@pytest.mark.parametrize(("name", "true_hz"), [("emps", 19.1), ("scara", 5.0), ("tx40", 10.0)])
def test_tracking_gives_the_bandwidth(name, true_hz):
    found_hz, deviation = tracking_bandwidth(simulated(name))
    assert found_hz == pytest.approx(true_hz, rel=0.3)
    assert deviation < 0.1


@pytest.mark.parametrize(("name", "lowest_hz", "highest_hz"), [("emps", 16, 25), ("scara", 4, 6.5), ("tx40", 10, 28.3)])
def test_shipped_sessions_give_theirs(name, lowest_hz, highest_hz):
    """The TX40's drives have position loops of 10 Hz, with velocity loops and an integral: together w_n is 28 Hz."""
    found_hz, _ = tracking_bandwidth(load_signals(REPLAY / name / "session.mcap"))
    assert lowest_hz < found_hz < highest_hz


def test_a_fit_uses_it_and_says_so():
    signals = simulated("scara")
    fit = identify_ls(signals, Overrides())
    bandwidth_hz = fit.problem.signals.robot.bandwidth_hz
    assert bandwidth_hz == pytest.approx(5.0, rel=0.3)
    assert fit.settings.cutoff_hz == pytest.approx(5 * bandwidth_hz)
    assert f"estimated as {bandwidth_hz:.3g} Hz" in " ".join(fit.warnings)


def test_a_recording_read_again_has_the_same():
    problem = make_problem(simulated("scara"), Overrides())
    again = replace(problem, source=simulated("scara")).without_samples().with_samples()
    assert again.signals.robot.bandwidth_hz == problem.signals.robot.bandwidth_hz
    assert again.signals.assumed == problem.signals.assumed != ()


def test_without_reference_a_cutoff_is_proposed_and_taken():
    signals = replace(simulated("scara"), q_ref=None)
    with pytest.raises(IdentificationError, match=r"bandwidth_hz is missing: .*--cutoff-hz") as refused:
        make_problem(signals, Overrides())
    proposed = float(str(refused.value).split("--cutoff-hz ")[1].split(",")[0])
    assert 4.0 < proposed < 100.0  # the reference has up to 1 Hz; half the rate is 500 Hz
    problem = make_problem(signals, Overrides(cutoff_hz=proposed))
    assert problem.signals.robot.bandwidth_hz == pytest.approx(proposed / 5)
    assert "a fifth of the cut-off" in problem.settings.warnings[0]


def test_tracking_without_information_is_refused():
    signals = simulated("scara")
    assert signals.q_ref is not None
    noise = np.random.default_rng(1).standard_normal(signals.q.shape)
    lost = replace(signals, q=signals.q_ref + 1e-2 * noise)
    with pytest.raises(IdentificationError, match=r"controller\.bandwidth_hz is missing"):
        make_problem(lost, Overrides())


def test_a_stated_bandwidth_stays():
    signals = simulated("scara")
    controller = msgspec.structs.replace(signals.robot.controller, bandwidth_hz=3.0)
    stated = replace(signals, robot=replace(signals.robot, controller=controller))
    assert make_problem(stated, Overrides()).signals is not None
    assert make_settings(stated, Overrides()).cutoff_hz == 15.0
    assert make_problem(stated, Overrides()).signals.robot.bandwidth_hz == 3.0


def test_noise_of_the_encoder_is_no_loop():
    signals = simulated("emps")
    noise = 2e-5 * np.random.default_rng(1).standard_normal(signals.q.shape)
    assert tracking_bandwidth(replace(signals, q=signals.q + noise))[0] == pytest.approx(19.1, rel=0.15)
