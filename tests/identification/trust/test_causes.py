"""What is wrong with a recording is named: exchanged efforts, wrong signs, unstated limits,
units, a period for a rate.
"""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from conftest import robot_named
from hunt import fit_by_default, fit_by_least_squares
from hunt_kinds import KINDS, SetUp, of_motors, sound
from independent_simulator import at_rate

from identification.data import Signals
from identification.errors import BadInputError, RobotIdimError
from identification.regression import Lag, Overrides, combined_lag, make_problem
from identification.results import Evidence
from identification.simulation import unstated_limits


def setup(name: str, seed: int = 1, duration_s: float = 5.0) -> SetUp:
    return replace(
        sound(name, np.random.default_rng(seed)),
        duration_s=duration_s,
        substeps=1,
    )


def first(fit: Evidence) -> tuple[str, str]:
    """Verdict and finding: what the user reads first."""
    return fit.trust.verdict, fit.trust.lines[0].finding or fit.trust.lines[0].test


def with_sign(signals: Signals, motor: int) -> Signals:
    factor = np.where(np.arange(signals.robot.n) == motor, -1.0, 1.0)
    return of_motors(lambda efforts: factor * efforts)(signals)


def test_swapped_efforts_named():
    signals = setup("scara", 2).recording(2)
    fit = fit_by_least_squares(replace(signals, effort=signals.effort[:, ::-1]))
    assert first(fit) == ("do not use", "the efforts of motor_1 and motor_2 are swapped")
    error = fit.trust.line("signs and order").text.split("fall from ")[1]
    with_it, left = (float(text.split(" %")[0]) for text in error.split(" to "))
    sound_errors = [
        joint.moving_relative_error_percent for joint in fit_by_least_squares(signals).errors[:-1]
    ]
    assert left == pytest.approx(np.sqrt(np.mean(np.square(sound_errors))), rel=0.3)
    assert with_it > 50


def test_wrong_sign_names_motor_unless_all_wrong():
    signals = setup("scara", 3).recording(3)
    wrong = with_sign(signals, 1)
    turned = np.array([-1.0, 1.0])
    for one, finding in (
        (wrong, "the effort of motor_2 has the wrong sign"),
        (
            replace(signals, q=turned * signals.q, q_ref=turned * signals.q_ref),
            "the position of motor_1 has the wrong sign",
        ),
        (with_sign(wrong, 0), "physical plausibility"),
    ):
        assert first(fit_by_least_squares(one)) == ("do not use", finding)


def test_coupled_wrist_names_motor():
    signals = setup("tx40", 1).recording(1)
    assert not {"signs and order", "saturation", "positions"} & {
        line.test for line in fit_by_least_squares(signals).trust.lines
    }
    assert first(fit_by_least_squares(with_sign(signals, 4))) == (
        "do not use",
        "the effort of motor_5 has the wrong sign",
    )
    R, zero = signals.robot.R, signals.robot.zero
    turn = np.linalg.solve(R, np.diag([1.0, 1, 1, 1, -1, 1]) @ R)
    q, q_ref = ((x - zero) @ turn.T + zero for x in (signals.q, signals.q_ref))
    assert first(fit_by_least_squares(replace(signals, q=q, q_ref=q_ref))) == (
        "do not use",
        "the position of motor_5 has the wrong sign",
    )
    order = [0, 1, 2, 4, 3, 5]
    swapped = of_motors(lambda efforts: efforts[:, order])(signals)
    assert first(fit_by_least_squares(swapped)) == (
        "do not use",
        "the efforts of motor_4 and motor_5 are swapped",
    )
    by_joint = replace(signals, effort=signals.effort[:, [0, 1, 2, 3, 5, 4]])
    assert first(fit_by_least_squares(by_joint)) == (
        "do not use",
        "the efforts of joint_5 and joint_6 are swapped",
    )


def test_missing_drive_limit_named():
    """The simulation cannot follow: refused, or told first."""
    saturated = replace(setup("scara", 4), saturated=0.8).recording(4)
    try:
        told = " ".join(first(fit_by_default(saturated)))
    except RobotIdimError as error:
        told = str(error)
    assert "saturates at" in told


def test_limits_are_plateaus_not_peaks():
    t, robot = np.arange(10_000) / 1000, robot_named("scara")
    q = np.stack([np.sin(2 * np.pi * 0.5 * t), np.sin(2 * np.pi * 0.7 * t)], axis=1)
    effort = np.stack([10 * np.sin(2 * np.pi * 0.5 * t), 2 * np.sin(2 * np.pi * 0.9 * t)], axis=1)
    effort += 0.02 * np.random.default_rng(0).standard_normal(effort.shape)

    def limits(effort: np.ndarray, **saturation: float) -> list[str]:
        motors = tuple(msgspec.structs.replace(motor, **saturation) for motor in robot.motors)
        own = replace(robot, motors=motors)
        signals = Signals(
            t_s=t, q=q, effort=effort, sample_rate_hz=1000.0, robot=own, recording="log"
        )
        return unstated_limits(make_problem(signals, Overrides(span="all")))

    assert limits(effort) == []
    clipped = np.clip(effort, -8.0, 8.0)
    (found,) = limits(clipped)
    # of acos(0.8) / (pi / 2) = 41 % of the samples
    assert found.startswith("drive of motor_1 saturates at 8 N m in 4")
    assert limits(clipped, saturation=8.0) == []
    assert limits(clipped, saturation=20.0) == [found]


def test_radians_declared_as_degrees_queried():
    signals = (
        KINDS["radians declared as degrees"]
        .change(setup("scara"), np.random.default_rng(1))
        .recording(1)
    )
    assert first(fit_by_least_squares(signals)) == ("caution", "radians declared as degrees?")


@pytest.mark.parametrize(
    ("bandwidth_hz", "rate_hz", "least_hz"), [(5.0, 0.001, 10), (None, 0.001, 1), (None, 1.0, 1)]
)
def test_period_given_as_rate_refused(bandwidth_hz, rate_hz, least_hz):
    signals = setup("scara", duration_s=1.0).recording(1)
    robot = replace(
        signals.robot, controller=type(signals.robot.controller)(bandwidth_hz=bandwidth_hz)
    )
    with pytest.raises(BadInputError) as refused:
        make_problem(replace(at_rate(signals, rate_hz), robot=robot), Overrides())
    assert refused.value.key == "sample_rate_hz"
    assert refused.value.expected == (
        f"more than {least_hz} Hz, twice the bandwidth of the position loop"
    )


def test_delay_compared_by_students_t():
    """3.48 deviations are the quantile 0.9985 of Student's t of 16 degrees of freedom (tables),
    2.97 that of a normal law.
    """
    known = Lag(value_s=0.0, sd_s=1e-9, source="effort_timing", period_s=1e-3)
    sources = [
        [
            combined_lag(known, (t * 1e-3, 1e-3, freedom)).source == "data"
            for t in (2.9, 3.05, 3.4, 3.55)
        ]
        for freedom in (16, 10**6)
    ]
    assert sources == [[False, False, False, True], [False, True, True, True]]
    # the deviation of the data hardly counts
    assert combined_lag(replace(known, sd_s=1e-2), (31e-3, 1e-3, 4)).source == "data"
