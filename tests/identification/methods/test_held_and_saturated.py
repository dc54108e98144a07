"""Instrumental variables where a joint is held, where a drive is saturated, and where the reference
is of another recording.
"""

import dataclasses
from functools import cache

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, robot_named
from described_truth import off
from independent_robots import plant
from independent_simulator import (
    Imperfections,
    Reference,
    Runs,
    described_controller,
    references,
    simulate,
)

from acquisition.robot import Joint, Robot
from identification.data import Signals
from identification.errors import RobotIdimError
from identification.methods import Iteration
from identification.regression import Overrides, largest_of_type
from identification.results import identify_iv

CELL = Imperfections(encoder_noise=2e-5, encoder_step=1e-5, torque_noise_percent=1.0)


LIMITS = 38.0, 100.0  # N m, of the run that saturates


@cache
def simulated() -> Runs:
    """4 s of the SCARA, friction close to dry, four times: as it is, with one of its joints held by
    its reference, and with drives that saturate.
    """
    body = plant(REPLAY / "scara" / "robot.toml", smooth=0.0005)
    path = references(body, range(6, 7), duration_s=4.0, rate_hz=1000.0)
    q, dq, ddq = (np.repeat(x, 4, axis=0) for x in (path.q, path.dq, path.ddq))
    for run in (1, 2):
        q[run, :, run - 1] = q[run, 0, run - 1]
        dq[run, :, run - 1] = ddq[run, :, run - 1] = 0.0
    limits = np.array([*[(np.inf, np.inf)] * 3, LIMITS])
    controller = dataclasses.replace(described_controller(body), saturation=limits)
    return simulate(body, controller, Reference(q=q, dq=dq, ddq=ddq), CELL)


def recorded(limits: tuple[float, float] | None = None, *, held: int = -1) -> Signals:
    """A run whose drives are described with limits in N m."""
    return simulated().signals(scara(limits), 3 if limits == LIMITS else 1 + held)


def scara(saturation: tuple[float, float] | None = None) -> Robot:
    robot = robot_named("scara")
    limits = zip(robot.motors, saturation or (None, None), strict=True)
    motors = [msgspec.structs.replace(motor, saturation=limit) for motor, limit in limits]
    return dataclasses.replace(robot, motors=tuple(motors))


def refusal(signals: Signals) -> str:
    with pytest.raises(RobotIdimError) as refused:
        identify_iv(signals, Overrides(), Iteration())
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.mark.parametrize("held", [0, 1])
def test_held_joint_does_not_block_others(held):
    """The heavy shoulder hardly moves: its friction, which is not dry at 1 mrad/s, is not looked
    at. The elbow is pushed.
    """
    signals = recorded(held=held)
    fit = identify_iv(
        dataclasses.replace(signals, effort_timing="command"), Overrides(), Iteration()
    )
    assert fit.status == "converged"
    moved = [not (held == 0 and name in ("Fv1", "Fc1")) for name in fit.estimate.names]
    assert off(fit)[moved].max() < 1.5
    errors = [joint.position_error_percent for joint in fit.direct]
    assert errors[held] is None
    assert errors[1 - held] < 1.0
    # The shoulder creeps, where friction is no longer dry: nobody is to take its values
    # for those of motion.
    cautions = [
        line.text for line in fit.trust.lines if line.test == "motion" and line.level == "caution"
    ]
    assert [text.split(",")[0] for text in cautions] == (
        ["joint shoulder does not move"] if held == 0 else []
    )


def test_saturated_reference_is_not_foreign():
    signals = recorded(LIMITS)
    fit = identify_iv(signals, Overrides(), Iteration())
    share = 100 * (np.abs(signals.effort[:, 0]) > 0.995 * LIMITS[0]).mean()
    # those between first and last motion count
    assert fit.saturated_percent == pytest.approx(share, abs=5)
    assert f"motor_1 (38 N m) in {fit.saturated_percent:.1f} % of the samples" in " ".join(
        fit.warnings
    )
    # A limit that is not stated is found, but the simulated drives would not have it.
    unknown = refusal(dataclasses.replace(signals, robot=scara()))
    assert "drive of motor_1 saturates at 38" in unknown
    assert "Specify the saturation of the motor" in unknown


NEVER_REACHED = (1000.0, 1000.0)  # saturation is no excuse


@pytest.mark.parametrize(
    ("held", "changed", "limits"),
    [
        (-1, lambda r: r[::-1], NEVER_REACHED),  # another motion
        (-1, lambda r: r[:, ::-1], NEVER_REACHED),  # exchanged joints
        (-1, lambda r: r * [1.0, np.pi / 180], NEVER_REACHED),  # one joint in other units
        (-1, lambda r: r * [1.0, 180 / np.pi], NEVER_REACHED),
        (1, lambda r: r[::-1], None),
        # the reference of the elbow stands, and it moves
        (-1, lambda r: recorded(held=1).q_ref, None),
    ],
)
def test_foreign_reference_refused(held, changed, limits):
    signals = recorded(limits, held=held)
    foreign = dataclasses.replace(signals, q_ref=np.array(changed(signals.q_ref)))
    assert "Use the reference of this recording" in refusal(foreign)


def test_foreign_reference_of_slow_joint_refused():
    """It goes by its own travel, a tenth of the shoulder's."""
    signals = recorded()
    q, q_ref = (x * [1.0, 0.1] for x in (signals.q, signals.q_ref))
    q_ref[:, 1] = q_ref[::-1, 1]
    assert "reference of joint elbow" in refusal(dataclasses.replace(signals, q=q, q_ref=q_ref))


def test_travel_compared_within_joint_type():
    first = robot_named("scara").joints[0]
    slide = Joint(name="slide", type="prismatic")
    joints = [first, slide, first, slide]
    np.testing.assert_array_equal(
        largest_of_type(np.array([1.0, 0.2, 0.0, 0.3]), joints), [1.0, 0.3, 1.0, 0.3]
    )
    np.testing.assert_array_equal(
        largest_of_type(np.array([1.0, 0.0, 2.0, 0.0]), joints), [2.0, 2.0, 2.0, 2.0]
    )
