"""References as motion: limits on both of their sides, moves from rest to rest, series and
splines against calculus.
"""

import re

import numpy as np
import pytest
from made_up_buses import bus_text, robot_of

from acquisition.errors import BadInputError
from acquisition.robot import Robot, approach, check_limits, fourier_reference, table_reference

DEG = np.pi / 180
PERIOD_S = 0.002


def robot_with(
    low: float = -150, high: float = 60, speed: float = 200, acceleration: float = 4000
) -> Robot:
    first, _, second = bus_text(2).partition('name = "joint_2"')
    second = second.replace("[-150, 150]", f"[{low}, {high}]").replace(
        "speed_deg_s = 200", f"speed_deg_s = {speed}"
    )
    second = second.replace("acceleration_deg_s2 = 4000", f"acceleration_deg_s2 = {acceleration}")
    return robot_of(f'{first}name = "joint_2"{second}')


def told(values: np.ndarray, robot: Robot) -> str:
    with pytest.raises(BadInputError) as caught:
        check(values, robot)
    return str(caught.value)


def check(values: np.ndarray, robot: Robot) -> None:
    check_limits(np.column_stack([np.zeros(len(values)), values]), robot, PERIOD_S, "here")


@pytest.mark.parametrize(("sign", "limit_deg"), [(1, 60.0), (-1, 150.0)])
def test_positions_at_and_beyond_limits(sign, limit_deg):
    """A slow ramp to the end and back passes; a billionth of the larger limit, 150 degrees,
    beyond it is rounding.
    """
    ramp = np.sin(np.linspace(0, np.pi, 5001)) ** 2 * sign
    check(ramp * (limit_deg + 0.9e-9 * 150) * DEG, robot_with())
    told(ramp * (limit_deg + 1.1e-9 * 150) * DEG, robot_with())
    beyond = told(ramp * (limit_deg + 0.01) * DEG, robot_with())
    # The first row beyond: where the sine squared is the share of the end in the way.
    k = int(np.ceil(np.arcsin(np.sqrt(limit_deg / (limit_deg + 0.01))) / np.pi * 5000))
    found = f"at {k * PERIOD_S:.4g} s: position of joint_2 = {sign * limit_deg * DEG:.4g} rad"
    assert beyond == f"here: {found}: expected {-150 * DEG:.4g} to {60 * DEG:.4g}"


@pytest.mark.parametrize("sign", [1, -1])
def test_speed_limit_both_sides(sign):
    """A ramp of 200 deg/s between rows at rest; the steps at its ends need acceleration,
    which is not limited here.
    """
    robot = robot_with(acceleration=1e9)
    ramp = (
        sign
        * np.r_[0.0, np.cumsum(np.r_[np.zeros(5), np.full(100, 200 * DEG * PERIOD_S), np.zeros(5)])]
    )
    check(ramp, robot)
    expected = (
        f"here: at 0.012 s: speed of joint_2 = {sign * 200.2 * DEG:.4g} rad/s: expected -3.491 "
        "to 3.491"
    )
    assert told(1.001 * ramp, robot) == expected


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("braking", [False, True])
def test_acceleration_limit_both_sides(sign, braking):
    """Half a parabola of 4000 deg/s² up, at constant speed on, and one that is a thousandth
    steeper, from either end.
    """
    a = 4000 * DEG
    gentle, steep = np.full(20, a / 2), np.full(10, 1.001 * a)
    up, down = (gentle, -steep) if braking else (steep, -gentle)
    speeds = np.r_[0.0, np.cumsum(np.r_[up, np.zeros(5), down]) * PERIOD_S]
    speeds[-1] = 0.0
    path = sign * np.r_[0.0, 0.0, np.cumsum(speeds * PERIOD_S), 0.0]
    path[-1] = path[-2]
    robot, value = robot_with(speed=1e6), sign * (-1 if braking else 1) * 1.001 * a
    assert f"acceleration of joint_2 = {value:.4g} rad/s²: expected -69.81 to 69.81" in told(
        path, robot
    )
    check(path / 1.002, robot)


def test_reference_not_at_rest_at_ends():
    """The first and last step count from standstill: 0.1 rad at once are 25000 rad/s²."""
    robot = robot_with(speed=1e6, acceleration=1e6)
    for value in (np.nan, np.inf, -np.inf, 1e308):  # no number is within a limit
        said = told(np.array([0, 0, value, 0, 0]), robot)
        assert re.fullmatch(
            r"here: at 0.004 s: position of joint_2 = .*: expected -2.618 to 1.047", said
        )
    for path in (np.r_[0.0, np.full(9, 0.1)], np.r_[np.full(9, 0.0), 0.1]):
        assert "acceleration of joint_2 = 2.5e+04 rad/s²" in told(path, robot)


@pytest.mark.parametrize("quantity", ["position", "speed", "acceleration", "following error"])
def test_no_motion_without_limits(quantity):
    text = re.sub(
        f"^{quantity.replace(' ', '_')}_deg.*$", "", bus_text(2), count=1, flags=re.MULTILINE
    )
    said = told(np.zeros(3), robot_of(text))
    assert said.startswith(f"here: joint[0] (joint_1) has no {quantity} limit. Add it")


@pytest.mark.parametrize(
    ("speed", "acceleration", "seconds"),
    [
        (200, 1e6, 1.875 * 90 / 20),  # a quintic from rest to rest has 15/8 of its mean speed
        (1e4, 40, np.sqrt(10 / np.sqrt(3) * 90 / 4)),  # and 10/sqrt(3) distance/T² of acceleration
    ],
)
def test_approach_uses_tenth_of_limits(speed, acceleration, seconds):
    start, end = np.array([0.1, -80 * DEG]), np.array([0.05, 10 * DEG])
    q = approach(start, end, robot_with(speed=speed, acceleration=acceleration), PERIOD_S)
    assert (len(q) - 1) * PERIOD_S == pytest.approx(seconds, abs=2 * PERIOD_S)
    assert (len(approach(start, start, robot_with(), PERIOD_S)) - 1) * PERIOD_S == pytest.approx(
        0.2
    )
    x = np.arange(len(q)) / (len(q) - 1)
    assert q == pytest.approx(
        start + np.outer(10 * x**3 - 15 * x**4 + 6 * x**5, end - start), abs=1e-12
    )


@pytest.mark.parametrize("period_s", [1.0, 5.0, 60.0])
def test_random_series_uses_80_percent_of_limit(period_s):
    reference = fourier_reference(
        robot_with(speed=100, acceleration=300), period_s=period_s, seed=1
    )
    assert reference.sine.shape == reference.cosine.shape == (2, 5)
    q, dq, ddq = reference.at(t := np.linspace(0, period_s, 20001))
    for x, derivative in ((q, dq), (dq, ddq)):
        np.testing.assert_allclose(
            np.gradient(x, t, axis=0)[1:-1], derivative[1:-1], atol=1e-4 * np.abs(derivative).max()
        )
    for j, (low, high, speed, acceleration) in enumerate(
        ((-150, 150, 200, 4000), (-150, 60, 100, 300))
    ):
        used = np.ptp(q[:, j]), np.abs(dq[:, j]).max(), np.abs(ddq[:, j]).max()
        assert max(np.array(used) / DEG / (high - low, speed, acceleration)) == pytest.approx(
            0.8, rel=1e-3
        )
        assert (q[:, j].max() + q[:, j].min()) / 2 == pytest.approx(
            (low + high) / 2 * DEG, abs=1e-4
        )
    for x in (dq, ddq):
        assert np.abs(x[[0, -1]]).max() < 1e-9 * np.abs(x).max()
    assert q[-1] == pytest.approx(q[0])


def test_random_series_without_speed_limit():
    robot = robot_of(
        bus_text(1).replace("speed_deg_s = 200", "").replace("acceleration_deg_s2 = 4000", "")
    )
    reference, again, other = (
        fourier_reference(robot, period_s=10.0, seed=seed) for seed in (3, 3, 4)
    )
    q, _, _ = reference.at(np.linspace(0, 10, 20001))
    assert [q.min(), q.max()] == pytest.approx([-120 * DEG, 120 * DEG], abs=1e-4)
    assert again.sine.tolist() == reference.sine.tolist()
    assert other.sine.tolist() != reference.sine.tolist()


def test_random_series_without_range_is_refused():
    """It has no range of 1 rad to each side by itself."""
    with pytest.raises(BadInputError) as error:
        fourier_reference(
            robot_of(bus_text(1).replace("position_deg = [-150, 150]", "")), period_s=10.0, seed=3
        )
    assert (error.value.key, error.value.value) == ("joint[0].position_deg", None)
    assert error.value.place.endswith("joint joint_1")
    for period_s in (0.0, -1.0, float("nan")):
        with pytest.raises(BadInputError, match=f"period_s = {period_s}: expected greater than 0"):
            fourier_reference(robot_of(bus_text(1)), period_s=period_s, seed=0)


def test_table_is_spline_at_rest_at_ends(tmp_path):
    """Between two rows the clamped cubic is 3 x² - 2 x³; times count from the first
    row; columns go by name.
    """
    path = tmp_path / "ref.csv"
    path.write_text("joint_2,time_s,joint_1\n0.5,10,0\n0.3,10.1,1\n")
    q = table_reference(path, robot_of(bus_text(2)), PERIOD_S)
    x = np.arange(51) / 50
    assert q[:, 0] == pytest.approx(3 * x**2 - 2 * x**3, abs=1e-12)
    assert q[:, 1] == pytest.approx(0.5 - 0.2 * (3 * x**2 - 2 * x**3), abs=1e-12)


@pytest.mark.parametrize(
    ("rows", "period_s", "expected"),
    [
        ("0,0,0\n1,1,0\n0.5,0,0", 0.002, "time_s: the table has fewer than 2 rows, or times"),
        ("0,0,0\n1e-310,0,1\n1,0,0", 0.002, "no smooth path leads through rows 1e-310 s apart with "
                                            "positions of up to 1. Give times in s"),
        ("0,0,0\n1,0,1e308\n2,0,-1e308", 0.002, "no smooth path leads through rows 1 s apart with "
                                                "positions of up to 1e+308. Give times in s"),
        ("0,0,0\n86401,1,1", 1.0, "time_s: the path takes 86401 s: expected at most 86400 s, with"),
        ("0,0,0\n6000,1,1", 1e-4, "time_s: the path takes 6000 s: expected at most 5000 s, with "
                                  "SYNC every 0.0001"),
    ],
)  # fmt: skip
def test_invalid_tables(tmp_path, rows, period_s, expected):
    path = tmp_path / "ref.csv"
    path.write_text(f"time_s,joint_1,joint_2\n{rows}\n")
    with pytest.raises(BadInputError, match=re.escape(f"{path}: {expected}")):
        table_reference(path, robot_of(bus_text(2)), period_s)


def test_table_of_a_day_and_without_joint(tmp_path):
    path = tmp_path / "ref.csv"
    path.write_text("time_s,joint_1\n0,0\n86400,1\n")
    assert len(table_reference(path, robot_of(bus_text(1)), 1.0)) == 86401
    with pytest.raises(BadInputError, match="'joint_2' does not exist"):
        table_reference(path, robot_of(bus_text(2)), 1.0)
