"""What a fit advises, followed: the fit of the described, or recorded, remedy is right, or is not
`trust`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import pytest
from hunt import HALF_WIDTHS, fit_by_default, is_harmed, true_values
from hunt_kinds import KINDS, SetUp, ratio_of_one, sound, times_effort

from acquisition.robot import Robot
from identification.results import Evidence


def cell(name: str = "scara") -> SetUp:
    setup = sound(name, np.random.default_rng(4))
    return replace(setup, timing="command", duration_s=10.0, substeps=1)


def faulty(kind: str) -> SetUp:
    return KINDS[kind].change(cell(), np.random.default_rng(4))


def with_joints(robot: Robot, **changes: object) -> Robot:
    return replace(robot, joints=tuple(msgspec.structs.replace(x, **changes) for x in robot.joints))


def add(torque: Callable[[object], np.ndarray]):
    return lambda signals: replace(signals, effort=signals.effort + torque(signals))


def spring(signals) -> np.ndarray:
    return 30.0 * signals.q * [0.0, 1.0]


def saturated(signals) -> Robot:
    """With the limits that the record shows."""
    robot = signals.robot
    peak = np.abs(robot.motor_effort(signals.effort)).max(axis=0)
    each = zip(robot.motors, peak, strict=True)
    return replace(
        robot,
        motors=tuple(msgspec.structs.replace(m, saturation=float(x)) for m, x in each),
    )


@dataclass(frozen=True, kw_only=True)
class Case:
    """A fault, what the user reads of it, and what the advice changes of the recording.

    right: whether the fit that follows must be trusted; else it may also say that it must not be.
    """

    faulty: Callable[[], SetUp]
    advice: str
    follow: Callable
    right: bool = True


def described(**changes: object):
    return lambda signals: replace(signals, robot=with_joints(signals.robot, **changes))


CASES = {
    "a rotor that is denied": Case(
        faulty=lambda: faulty("rotor denied"),
        advice="as it explains as much, rotor of joint elbow missing",
        follow=described(rotor_inertia=True),
    ),
    "friction by direction": Case(
        faulty=lambda: cell().with_friction(asymmetry=0.3),
        advice='friction = "asymmetric"',
        follow=described(friction="asymmetric", viscous=None, coulomb=None, offset=None),
    ),
    "an offset": Case(
        faulty=lambda: cell().changed(add(lambda x: 0.5 * np.abs(x.effort).mean(axis=0))),
        advice="offset = true",
        follow=described(offset=True),
    ),
    "a spring": Case(
        faulty=lambda: cell().changed(add(spring)),
        advice="known_torque",
        follow=lambda signals: replace(signals, known_torque=-spring(signals), q_ref=None),
    ),
    "Stribeck friction": Case(
        faulty=lambda: cell("emps").with_friction(stribeck=0.5),
        advice="low_speed_percent",
        follow=lambda signals: replace(
            signals,
            robot=replace(
                signals.robot,
                identification=msgspec.structs.replace(
                    signals.robot.identification, low_speed_percent=15.0
                ),
            ),
        ),
        right=False,
    ),
    "a limit of the drive": Case(
        faulty=lambda: replace(cell(), saturated=0.9),
        advice="saturation",
        follow=lambda signals: replace(signals, robot=saturated(signals)),
        right=False,
    ),
    "a wrong sign": Case(
        faulty=lambda: cell().changed(times_effort(np.array([1.0, -1.0]))),
        advice="sign",
        follow=times_effort(np.array([1.0, -1.0])),
    ),
    "two efforts exchanged": Case(
        faulty=lambda: faulty("efforts of two motors exchanged"),
        advice="are swapped",
        follow=lambda signals: replace(signals, effort=signals.effort[:, ::-1]),
    ),
}


def texts(fit: Evidence) -> list[str]:
    return [
        f"{line.text} {line.advice}"
        for line in fit.trust.lines
        if line.level in ("do not use", "caution")
    ]


@pytest.mark.parametrize("fault", CASES)
def test_fit_after_advice_is_right(fault):
    case = CASES[fault]
    signals = case.faulty().recording(5)
    told = texts(fit_by_default(signals))
    assert any(case.advice in text for text in told), told
    fit = fit_by_default(case.follow(signals))
    if case.right:
        assert fit.trust.verdict == "trust", texts(fit)
    assert fit.trust.verdict != "trust" or not harmed(fit)


def harmed(fit: Evidence) -> bool:
    """By what both descriptions have."""
    name = fit.problem.signals.robot.name.lower()
    true, half = true_values(name), dict(zip(fit.estimate.names, fit.intervals.half, strict=True))
    found = dict(zip(fit.estimate.names, fit.estimate.beta, strict=True))
    common = true.keys() & found.keys() & set(fit.essential.names)
    assert len(common) >= 2
    return any(
        abs(found[x] - true[x]) > max(HALF_WIDTHS * half[x], 0.02 * abs(true[x])) for x in common
    )


@pytest.mark.parametrize("seed", range(3))
def test_no_advice_makes_wrong_ratio_trusted(seed):
    """Rotors take what a wrong ratio leaves: whatever is offered, described, leaves a doubt."""
    rng = np.random.default_rng(seed)
    setup = replace(sound("tx40", rng), timing="command", substeps=1)
    signals = ratio_of_one(setup, rng).recording(seed)
    robot = with_joints(signals.robot, rotor_inertia=True)
    for changed in (signals, replace(signals, robot=robot)):
        fit = fit_by_default(changed)
        assert fit.trust.verdict != "trust" or not is_harmed(fit, "tx40")
