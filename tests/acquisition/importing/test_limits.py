"""Positions held against the description's limits: at import, at the decoding
of logs, and at a fit.
"""

import dataclasses
import math

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, needs_data, robot_named
from urdfs import TURN_AND_SLIDE, TURN_AND_SLIDE_TOML

from acquisition.errors import BadInputError
from acquisition.importing import import_tables
from acquisition.robot import (
    RADIANS_AS_DEGREES,
    check_recorded_efforts,
    check_recorded_positions,
    effort_limits,
    load_robot,
    robot_from_files,
)
from identification.data import Signals, load_signals, signals_from_arrays
from identification.regression import Overrides, make_problem, make_settings
from identification.results import identify

T = np.arange(4000) / 1000
TX40 = robot_named("tx40")


@pytest.fixture(scope="module")
def session() -> Signals:
    return load_signals(REPLAY / "scara" / "session.mcap")


def moving(n: int = 6) -> np.ndarray:
    return 0.5 * np.sin(2 * np.pi * 0.5 * T)[:, None] * np.ones(n)


def refusal(q: np.ndarray, robot=TX40, t=T) -> str:
    with pytest.raises(BadInputError) as caught:
        check_recorded_positions(robot, t, q, "log")
    return str(caught.value)


def swinging(joint: int, factor: float) -> np.ndarray:
    q, w = moving(), 2 * np.pi * 4
    q[:, joint] = factor * TX40.joints[joint].si("speed") / w * np.sin(w * T)
    return q


def beyond(joint: int, share: float) -> np.ndarray:
    q, (low, high) = moving(), TX40.joints[joint].si("position")
    q[:, joint] += high - 0.5 + share * (high - low)
    return q


SLOW = 0.04 * np.sin(2 * np.pi * 2 * T)[:, None] * np.ones(6)
NOISE = 5e-4 * np.random.default_rng(1).standard_normal((len(T), 6))


@pytest.mark.parametrize(
    ("q", "told"),
    [
        *((q, ()) for q in (moving(), moving() + NOISE, beyond(4, 0.005), swinging(0, 0.9))),
        (beyond(4, 0.49), ("joint joint_5",)),
        (swinging(0, 2.9), ("joint joint_1",)),
        (np.radians(moving()), (RADIANS_AS_DEGREES,)),
        (0.01 * np.radians(moving()), ()),  # it stands
    ],
)
def test_possible_motion_passes(q, told):
    found = check_recorded_positions(TX40, T, q, "log")
    assert tuple(text.split(" reaches ")[0] for text in found) == told


@pytest.mark.parametrize(
    ("q", "words", "without"),
    [
        (beyond(4, 0.51), ["joint joint_5 reaches"], ""),
        (swinging(0, 3.2), ["joint joint_1 reaches"], ""),
        (np.degrees(moving()), ["joint joint_1 reaches ", "outside its limits of ±180 deg",
                                "Check for degrees declared as rad"], ""),
        (100 * np.degrees(moving()), ["Check unit"], "degrees"),
        # so small that it stays within the limits
        (np.degrees(SLOW), ["speed", "degrees declared as radians"], ""),
    ],
)  # fmt: skip
def test_impossible_motion_is_refused(q, words, without):
    told = refusal(q)
    assert all(word in told for word in words)
    assert not without or without not in told.split("Check")[1]


@pytest.mark.parametrize("n", [40, 4000])
def test_wrong_positions_refused_before_their_span(n):
    """A fit would else refuse a recording that is too short, or a joint that stands."""
    q = np.full((n, 6), 50.0)
    with pytest.raises(BadInputError, match="limits of ±180 deg"):
        make_settings(signals_from_arrays(q, q, 1000.0, TX40), Overrides())


def test_jump_of_72_degrees_is_refused():
    joints = tuple(msgspec.structs.replace(joint, speed_deg_s=None) for joint in TX40.joints)
    q = moving()
    q[2000:, 2] += math.radians(72)
    told = refusal(q, dataclasses.replace(TX40, joints=joints))
    assert told.startswith("log: joint joint_3 jumps by ")
    assert "2.000 s" in told


def test_default_axis_speed_limit_is_30_m_s():
    emps = robot_named("emps")
    axis = msgspec.structs.replace(emps.joints[0], speed_m_s=None, position_m=(-10.0, 10.0))
    emps, w = dataclasses.replace(emps, joints=(axis,)), 2 * np.pi * 4
    swing = np.sin(w * T)[:, None] / w
    assert check_recorded_positions(emps, T, 29.0 * swing, "log") == ()
    assert "joint axis reaches" in refusal(31.0 * swing, emps)


@pytest.mark.parametrize(("ratio", "jump"), [(2.5, False), (4.0, True)])
def test_step_over_three_times_neighbours_is_jump(ratio, jump):
    q = moving()
    for k, factor in enumerate((1, 1, ratio, 1, 1)):
        q[2000 + k :, 2] += 0.05 * factor  # 50 rad/s
    q[:, 2] -= 0.1 + 0.025 * ratio
    assert ("jumps" in refusal(q)) == jump


def test_fit_refuses_impossible_motion(session):
    q, (_, high) = np.array(session.q), session.robot.joints[0].si("position")
    q[6000:, 0] += math.radians(72)
    with pytest.raises(BadInputError, match=r"session.mcap: joint shoulder jumps by 71.98 deg"):
        make_settings(dataclasses.replace(session, q=q), Overrides())
    shifted = dataclasses.replace(
        session, q=session.q + np.array([high + 0.2 - session.q[:, 0].max(), 0])
    )
    assert any(
        "joint shoulder reaches" in text for text in make_settings(shifted, Overrides()).warnings
    )


def test_real_records_pass_wrong_ratio_is_refused(tmp_path, emps, tx40):
    for path in (emps, tx40):
        signals = load_signals(path)
        check_recorded_positions(signals.robot, signals.t_s, signals.q, path.name)
    folder, out, table_map = REPLAY / "emps", tmp_path / "out.mcap", tmp_path / "map.toml"
    table_map.write_text(
        (folder / "map.toml").read_text().replace('unit = "m"', 'side = "motor"\nunit = "rad"')
    )
    robot = load_robot(folder / "robot.toml")
    motor = type(robot.motors[0])(name="m", drive_gain=35.0, drive_gain_unit="N/V")
    fast = dataclasses.replace(robot, motors=(motor,), R=np.array([[0.1]]))
    with pytest.raises(
        BadInputError, match=r"DATA_EMPS.mat: joint axis reaches .* m at .* s, outside .* ±0.15 m"
    ):
        import_tables([needs_data("emps", "DATA_EMPS.mat")], fast, table_map, out)
    assert not out.exists()


def urdf_arm(effort="80", elbow="", rail="", **instead):
    text = TURN_AND_SLIDE_TOML.format(elbow=elbow, rail=rail)
    for old, new in instead.values():
        text = text.replace(old, new)
    return robot_from_files(
        {"robot.toml": text.encode(), "robot.urdf": TURN_AND_SLIDE.format(effort=effort).encode()},
        "here",
    )


@pytest.mark.parametrize(
    ("keys", "key", "value"),
    [
        *(
            ({"effort": effort}, "urdf: joint elbow: effort", effort)
            for effort in ("-3", "inf", "nan", "much")
        ),
        ({"elbow": "effort_n = 3"}, "joint[0].effort_n", 3),
        ({"rail": "effort_nm = 3"}, "joint[1].effort_nm", 3),
        ({"elbow": "effort_nm = -3"}, "joint[0].effort_nm", -3),
    ],
)
def test_invalid_effort_limit_is_refused(keys, key, value):
    with pytest.raises(BadInputError) as caught:
        urdf_arm(**keys)
    assert (caught.value.key, caught.value.value) == (key, value)


@pytest.mark.parametrize(
    ("keys", "stated", "limits"),
    [
        ({}, [80.0, 40.0], [0.3 * 2.0 * 50, 40.0]),  # the saturation of the drive; the URDF
        ({"effort": "0"}, [None, 40.0], [0.3 * 2.0 * 50, 40.0]),
        ({"elbow": "effort_nm = 7", "rail": "effort_n = 8"}, [7.0, 8.0], [7.0, 8.0]),
    ],
)
def test_effort_limit_of_robot_toml_urdf_or_drive(keys, stated, limits):
    robot = urdf_arm(**keys)
    assert [joint.si("effort") for joint in robot.joints] == stated
    assert effort_limits(robot).names == ("joint elbow", "joint rail")
    assert effort_limits(robot).limits == pytest.approx(limits)


def test_object_range_is_no_effort_limit():
    assert effort_limits(TX40).names == ()
    motors = tuple(msgspec.structs.replace(motor, saturation=2.0) for motor in TX40.motors)
    limits = effort_limits(dataclasses.replace(TX40, motors=motors))
    assert limits.names == (*(f"joint joint_{j}" for j in (1, 2, 3, 4, 6)), "motor motor_5")
    assert limits.limits[[0, -1]] == pytest.approx([2.0 * 32, 2.0])
    tau = np.array([1.0, 2, 3, 4, 5, 6])
    assert limits.directions @ tau == pytest.approx(
        [1, 2, 3, 4, 6, TX40.motor_effort(tau[None])[0, 4]]
    )
    assert limits.units[-1] == "N m"


def test_limit_in_nm_does_not_limit_amperes():
    gain, force = 'drive_gain = 2.0\ndrive_gain_unit = "N m/A"', 'effort_unit = "N"'
    limits = effort_limits(
        urdf_arm(elbow_in=(gain, 'effort_unit = "A"'), rail_in=(force, 'effort_unit = "A"'))
    )
    assert (limits.names, limits.units) == (("joint elbow",), ("A",))
    assert limits.limits == pytest.approx([0.3 * 50])


def limited(signals: Signals, effort_nm: float) -> Signals:
    joints = tuple(
        msgspec.structs.replace(joint, effort_nm=effort_nm) for joint in signals.robot.joints
    )
    return dataclasses.replace(signals, robot=dataclasses.replace(signals.robot, joints=joints))


def test_fit_beyond_effort_limit_is_not_trusted(session):
    fit = identify(limited(session, 0.01), Overrides(), method="iv")
    (line,) = (line for line in fit.trust.lines if line.test == "effort")
    assert line.text.startswith("the effort of joint shoulder reaches ")
    assert line.text.split(": check")[0].split("; ") == [
        text for text in fit.warnings if text.startswith("the effort of ")
    ]
    assert (fit.trust.verdict, fit.trust.lines[0].finding) == ("caution", "effort above its limit")


def test_effort_over_limit_warns_with_known_gains(session):
    assert check_recorded_efforts(urdf_arm(), np.array([[10.0, 40.0], [-35.9, -47.9]])) == ()
    told = (
        "the effort of joint elbow reaches 36.1 N m, above its limit of 30 N m",
        "the effort of joint rail reaches 48.1 N, above its limit of 40 N",
    )
    assert check_recorded_efforts(urdf_arm(), np.array([[-36.1, 48.1]])) == told
    low = limited(session, 0.01)
    assert len(make_settings(low, Overrides()).overloads) == 2
    assert make_problem(low, Overrides(gains=("all",))).settings.overloads == ()
