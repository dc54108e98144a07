"""Corrected descriptions: by their own rule they give the motors' values that a mistake undone
gives, and keep everything else of the file.
"""

import tomllib

import numpy as np
import pytest
from descriptions import COUPLED, ONE_JOINT

from acquisition.robot import Robot, robot_from_files
from identification.errors import BadInputError
from identification.export import correct_description
from identification.report import Cause
from identification.trust.efforts import mistakes, undo

DH = "dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }"
THREE = "".join(
    f'[[joint]]\nname = "j{k}"\ntype = "revolute"\nposition_deg = {limits}\nzero_deg = {zero}\n'
    f'[[motor]]\nname = "m{k}"\nratio = {ratio}\ndrive_gain = 0.5 # catalogue\n'
    'drive_gain_unit = "N m/A"\n'
    for k, (limits, zero, ratio) in enumerate(
        (("[-90, 120]", 0, 10), ("[-10, 150]", 30, -20), ("[-60, 60]", 0, 40)), 1
    )
)
HEAD = 'name = "three"\n# of the cell\n'
NOWHERE = np.zeros((1, 3))


def robot_of(text: str, urdf: str = "") -> Robot:
    files = {"robot.toml": text.encode()} | ({"robot.urdf": urdf.encode()} if urdf else {})
    return robot_from_files(files, "robot.toml")


def three(head: str = HEAD) -> str:
    return f"{head}{THREE}[controller]\n".replace("position_deg", f"{DH}\nposition_deg")


@pytest.mark.parametrize("text", [three(), COUPLED, ONE_JOINT], ids=["three", "coupled", "one"])
def test_corrected_rule_undoes_each_mistake(text):
    """Of what motors reported, the corrected robot computes P q + t and A tau."""
    robot, rng = robot_of(text), np.random.default_rng(1)
    q, tau = rng.standard_normal((2, 5, robot.n))
    corrected = 0
    for x in mistakes(robot)[1:]:
        if x.keys(robot) is None:
            with pytest.raises(
                BadInputError, match=r"which no robot\.toml corrects\. Check this: "
            ):
                correct_description(robot, x.causes, q, "new.toml")
            continue
        new, lines = correct_description(robot, x.causes, q, "new.toml")
        assert lines
        np.testing.assert_allclose(
            new.joint_position(robot.motor_position(q)), q @ x.P.T + x.t, atol=1e-8
        )
        np.testing.assert_allclose(
            new.joint_effort(robot.motor_effort(tau)), tau @ x.A.T, atol=1e-8
        )
        np.testing.assert_allclose(new.gravity, robot.gravity + x.d, atol=1e-8)
        changed = ~np.isclose(
            np.c_[x.P, x.A, x.t], np.c_[np.eye(robot.n), np.eye(robot.n), 0 * x.t]
        )
        moved = changed.any(axis=1) | x.d.any()
        assert new.unconfirmed == tuple(np.array([j.name for j in robot.joints])[moved])
        corrected += 1
    kinds = {x.causes[0].kind for x in mistakes(robot)[1:] if x.keys(robot) is not None}
    assert {"backwards", "zero"} <= kinds
    assert {"effort", "position", "degrees"}.isdisjoint(kinds)
    assert corrected >= 5


def test_several_mistakes_are_undone_in_order():
    robot = robot_of(three())
    causes = (Cause("zero", ("j2",), 90.0), Cause("backwards", ("m2",)), Cause("unit", (), 1e3))
    done, q = undo(robot, causes), np.array([[0.1, 0.2, 0.3]])
    assert done.causes == causes
    turned = q - [[0, np.pi / 2, 0]]
    about = 2 * robot.zero[1] - turned[:, 1]  # mirrored about the zero of the motor
    np.testing.assert_allclose(q @ done.P.T + done.t, np.c_[turned[:, 0], about, turned[:, 2]])
    assert done.text == (
        "the zero of j2 is wrong by 90 deg, and position and effort of m2 have the wrong sign, and "
        "the efforts are 1000 times the true ones"
    )
    new, _ = correct_description(robot, causes, q, "new.toml")
    np.testing.assert_allclose(new.gain, 0.0005)
    assert tomllib.loads(new.files["robot.toml"].decode())["motor"][1]["ratio"] == 20.0


def test_only_lines_of_new_values_change():
    robot = robot_of(three())
    causes = (Cause("backwards", ("m1",)), Cause("zero", ("j3",), -90.0))
    new, lines = correct_description(robot, causes, NOWHERE, "new.toml")
    expected, was = three(), "# corrected from a recording, was"
    for before, now in (
        ("position_deg = [-90, 120]", f"{was} [-90.0, 120.0]\nposition_deg = [-120.0, 90.0]"),
        ("ratio = 10\n", f"{was} 10.0\nratio = -10.0\n"),
        ("position_deg = [-60, 60]\nzero_deg = 0", f"{was} [-60.0, 60.0]\nposition_deg = [30.0, "
         f"150.0]\n{was} 0.0\nzero_deg = 90.0"),
    ):  # fmt: skip
        assert expected.count(before) == 1
        expected = expected.replace(before, now)
    text = new.files["robot.toml"].decode()
    mark = 'unconfirmed = ["j1", "j3"]\n'
    assert mark in text
    above = text[text.index("# Nothing moves before") : text.index(mark)]
    assert all(line.startswith("# ") for line in above.splitlines())
    assert text.replace(above + mark, "") == expected
    assert lines == [
        "m1: ratio = -10.0 (was 10.0)",
        "j1: position_deg = [-120.0, 90.0] (was [-90.0, 120.0])",
        "j3: zero_deg = 90.0 (was 0.0)",
        "j3: position_deg = [30.0, 150.0] (was [-60.0, 60.0])",
    ]
    # A second correction adds its joints, and says once what to do.
    again, _ = correct_description(new, [Cause("backwards", ("m2",))], NOWHERE, "new.toml")
    assert again.unconfirmed == ("j1", "j2", "j3")
    assert again.files["robot.toml"].decode().count("Nothing moves before") == 1


@pytest.mark.parametrize(
    ("q1_deg", "urdf_deg", "limits"),
    [
        ((-80, 80), None, [-120.0, 90.0]),  # both fit: those of the file follow
        ((-80, 80), (-90, 120), [-90, 120]),  # the URDF's belong to its frames
        ((-80, 80), (-91, 120), [-120.0, 90.0]),
        ((-110, 10), None, [-90, 120]),  # only the present ones have the corrected positions
        ((-80, 115), None, [-120.0, 90.0]),
    ],
)
def test_limits_follow_sign_unless_of_true_frame(q1_deg, urdf_deg, limits):
    urdf, text = "", three()
    if urdf_deg:
        lower, upper = np.deg2rad(urdf_deg)
        urdf = f'<robot><joint name="j1"><limit lower="{lower}" upper="{upper}"/></joint></robot>'
        text = text.replace(f"{DH}\n", "").replace("# of the cell", 'urdf = "arm.urdf"')
    q = np.deg2rad([[q1_deg[0], 0, 0], [q1_deg[1], 0, 0]])
    new, _ = correct_description(robot_of(text, urdf), [Cause("backwards", ("m1",))], q, "new.toml")
    assert tomllib.loads(new.files["robot.toml"].decode())["joint"][0]["position_deg"] == limits


def test_gain_stays_where_other_keys_have_its_unit():
    for key in ("saturation = 3", "drive_gain_half_width = 0.1"):
        robot = robot_of(three().replace("ratio = 10", f"ratio = 10\n{key}"))
        with pytest.raises(BadInputError, match="correct unit in"):
            correct_description(robot, [Cause("unit", (), 1e3)], NOWHERE, "new.toml")


def test_nested_lists_and_inline_tables():
    text = COUPLED.replace("[[10, 4], [-3, 20]]", "[\n  [10, 4], # first\n  [-3, 20],\n]")
    robot = robot_of(text)
    new, _ = correct_description(robot, [Cause("backwards", ("m1",))], NOWHERE[:, :2], "new.toml")
    np.testing.assert_array_equal(new.R, [[-10, -4], [-3, 20]])
    inline = tomllib.loads(three())
    motors = ", ".join(
        f'{{ name = "{m["name"]}", ratio = {m["ratio"]}, effort_unit = "N m" }}'
        for m in inline["motor"]
    )
    joints = ", ".join(
        f'{{ name = "{j["name"]}", type = "revolute", {DH} }}' for j in inline["joint"]
    )
    text = f'name = "three"\njoint = [{joints}]\nmotor = [{motors}]\n[controller]\n'
    with pytest.raises(BadInputError, match=r"\[\[motor\]\]: cannot be replaced line by line"):
        correct_description(robot_of(text), [Cause("backwards", ("m1",))], NOWHERE, "new.toml")
