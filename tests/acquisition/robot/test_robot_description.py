"""robot.toml into a robot: what it means, and one line for each mistake.

Files that are whole or not there.
"""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from conftest import REPLAY
from descriptions import COUPLED, ONE_JOINT

from acquisition.errors import BadInputError, RobotIdimError, one_line
from acquisition.files import atomic_write, refuse_clash
from acquisition.robot import Robot, load_robot, robot_from_files

DH = "dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }"
GAIN = 'drive_gain = 0.2\ndrive_gain_unit = "N m/A"'


def described(text: str) -> Robot:
    return robot_from_files({"robot.toml": text.encode()}, "here")


def refused(text: str) -> RobotIdimError:
    with pytest.raises(BadInputError) as caught:
        described(text)
    assert str(caught.value).startswith("here: ")
    assert caught.value.place == "here"
    return caught.value


def test_coupled_robot_by_hand():
    """Motor 1 turns by 10 q1 + 4 q2, motor 2 by -3 q1 + 20 q2; joint 1 gets 10 tau_m1 - 3
    tau_m2, joint 2 the rest.
    """
    robot = described(COUPLED)
    q = np.array([[np.pi / 2 + 1.0, -np.pi / 4 + 2.0], [np.pi / 2, -np.pi / 4 - 0.5]])
    q_motor = np.array([[18.0, 37.0], [-2.0, -10.0]])
    assert robot.motor_position(q) == pytest.approx(q_motor)
    assert robot.joint_position(q_motor) == pytest.approx(q)
    # 2 A and 8 A are 1 N m and 2 N m at the motors.
    assert robot.joint_effort(np.array([[2.0, 8.0], [-2.0, 0.0]])) == pytest.approx(
        np.array([[4, 44], [-10, -4]])
    )
    assert robot.motor_effort(np.array([[4.0, 44.0], [-10.0, -4.0]])) == pytest.approx(
        np.array([[2, 8], [-2, 0]])
    )
    assert robot.gain.tolist() == [0.5, 0.25]
    assert not robot.R.flags.writeable
    assert robot.gravity.tolist() == [0, 9.81, 0]
    assert robot.effort_units == ("N m", "N m")


@pytest.mark.parametrize(
    ("quantity", "per", "value", "si"),
    [
        ("zero", "", 90.0, np.pi / 2),
        ("position", "", [-180.0, 45.0], (-np.pi, np.pi / 4)),
        ("acceleration", "_s2", 720.0, 4 * np.pi),
    ],
)
def test_limits_in_si(quantity, per, value, si):
    keys = {
        unit: ONE_JOINT.replace(DH, f"{DH}\n{quantity}_{unit}{per} = {value}")
        for unit in ("deg", "m")
    }
    (turning,) = described(keys["deg"]).joints
    assert (turning.si(quantity), turning.position_unit) == (pytest.approx(si), "rad")
    (sliding,) = described(keys["m"].replace("revolute", "prismatic")).joints
    given = tuple(value) if isinstance(value, list) else value
    assert (sliding.si(quantity), sliding.position_unit) == (given, "m")
    assert described(ONE_JOINT).joints[0].si(quantity) is None
    assert refused(keys["m"]).key == f"joint[0].{quantity}_m{per}"
    assert (
        refused(keys["deg"].replace("revolute", "prismatic")).key == f"joint[0].{quantity}_deg{per}"
    )


@pytest.mark.parametrize(
    ("kind", "motor", "gain", "recorded", "unit"),
    [
        ("revolute", 'drive_gain = 0.2\ndrive_gain_unit = "N m/V"', 0.2, "V", "N m"),
        ("prismatic", 'drive_gain = 2.0\ndrive_gain_unit = "N m/A"', 2.0, "A", "N"),
        ("revolute", 'effort_unit = "N m"', 1.0, "N m", "N m"),
        ("prismatic", 'effort_unit = "N m"', 1.0, "N m", "N"),
        ("revolute", 'effort_unit = "V"', None, "V", "V"),
    ],
)
def test_motor_gains_and_units(kind, motor, gain, recorded, unit):
    robot = described(ONE_JOINT.replace(GAIN, motor).replace("revolute", kind))
    assert (robot.motors[0].gain, robot.motors[0].recorded_unit) == (gain, recorded)
    assert (robot.effort_units, robot.gain_known) == ((unit,), gain is not None)
    assert robot.joint_effort(np.array([[1.0]])) == pytest.approx(np.array([[50 * (gain or 1.0)]]))
    assert robot.motor_effort(np.array([[50.0]])) == pytest.approx(np.array([[1 / (gain or 1.0)]]))


@pytest.mark.parametrize(
    ("old", "new", "key", "value", "expected"),
    [
        ('name = "one"', 'name = "a\\u001b[31m"', "name", "a\x1b[31m", "a text matching regex"),
        ("ratio = 50", "ratio = 0", "motor[0].ratio", 0.0, "it is 0, or given beside"),
        (GAIN, "", "motor[0].effort_unit", None, "no drive gain gives the unit"),
        (GAIN, "drive_gain = 0.2", "motor[0].drive_gain", 0.2,
         "only one of drive_gain and drive_gain_unit"),
        (GAIN, GAIN.replace("0.2", "-0.2"), "motor[0].drive_gain", -0.2, "it is not greater than"),
        (GAIN, GAIN + '\neffort_unit = "V"', "motor[0].effort_unit", "V",
         "drive_gain_unit is N m/A"),
        (DH, "", "joint[0].dh", None, "Give a dh row, or one urdf"),
        (DH, DH + "\nposition_deg = [90, -90]", "joint[0].position_deg", (90.0, -90.0),
         "[lowest, highest]"),
        (DH, DH + "\nposition_m = [0, 1]", "joint[0].position_m", (0.0, 1.0),
         "the joint is revolute"),
        ("[controller]", "[[motor]]\nname = 'two'\neffort_unit = 'A'\n[controller]", "motor",
         "2 tables", "1, one per joint"),
        ("bandwidth_hz = 20", "bandwidth_hz = 20\nposition_gain = [1, 2]",
         "controller.position_gain", [1.0, 2.0], "1 numbers"),
        ("bandwidth_hz = 20", "bandwidth_hz = 20\nintegral_gain = [-1]",
         "controller.integral_gain", [-1.0], "positive"),
        ('name = "one"', 'name = "one"\nmotor_matrix = [[0]]', "motor[0].ratio", 50.0,
         "it is 0, or given beside motor_matrix"),
        ('name = "one"', 'name = "one"\nunconfirmed = ["two"]', "unconfirmed", "two",
         "names of joints"),
        ("[[10, 4], [-3, 20]]", "[[10, 4], [5, 2]]", "motor_matrix", ((10.0, 4.0), (5.0, 2.0)),
         "an invertible matrix"),
        ("[[10, 4], [-3, 20]]", "[[0, 4], [-3, 20]]", "motor_matrix[0]", [0.0, 4.0],
         "motor 1 does not move joint 1"),
        ("[[10, 4], [-3, 20]]", "[[10, 4]]", "motor_matrix", [2], "2 rows of 2 numbers"),
        ('name = "second"', 'name = "first"', "joint[1].name", "first", "another joint has it"),
        ('drive_gain = 0.25\ndrive_gain_unit = "N m/A"', 'effort_unit = "A"', "motor.drive_gain",
         None, "m2 have none"),
    ],
)  # fmt: skip
def test_mistake_has_key_value_and_expectation(old, new, key, value, expected):
    text = next(one for one in (ONE_JOINT, COUPLED) if one.count(old) == 1)
    error = refused(text.replace(old, new))
    assert (error.key, error.value) == (key, value)
    assert (error.expected or error.text or error.advice).startswith(expected)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "one"', "", "top level: a key is missing: `name`"),
        ('name = "one"', 'name = "one"\n"a\\nb" = 3',
         "top level: there is an unknown key `a b`"),
        ("ratio = 50", f"ratio = {'9' * 1500}",
         f"motor[0].ratio = {'9' * 77}: Number out of range"),
        ("ratio = 50", "ratio = 50\nratio = 50", "not valid TOML: Cannot overwrite a value"),
        ("[[joint]]", f"a = {'[' * 1900}", "not valid TOML: "),
        ("[[joint]]", f"a{'.a' * 2000} = 1", "a line of 4005 bytes: expected at most 262144 and"),
        ("[[joint]]", "#\n" * 262144, "bytes and a line of "),
    ],
)  # fmt: skip
def test_mistake_is_one_line(old, new, message):
    assert ONE_JOINT.count(old) == 1
    assert message in str(refused(ONE_JOINT.replace(old, new)))


def test_missing_or_binary_robot_toml():
    for files, told in (
        ({"robot.toml": b"name = '\xff'"}, "this is not valid TOML: 'utf-8'"),
        ({}, r"the recording has no robot\.toml"),
    ):
        with pytest.raises(BadInputError, match=f"here: {told}"):
            robot_from_files(files, "here")


def test_urdf_is_included_or_missing(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(
        text := ONE_JOINT.replace(DH, "").replace('name = "one"', 'name = "one"\nurdf = "arm.urdf"')
    )
    for place, told in (
        (path, r"urdf = 'arm\.urdf': the file cannot be read"),
        (tmp_path / "none.toml", "cannot be read: No such"),
    ):
        with pytest.raises(BadInputError, match=told):
            load_robot(place)
    assert (refused(text).key, refused(text).value) == ("urdf", "arm.urdf")
    (tmp_path / "arm.urdf").write_text("<robot/>")
    robot = load_robot(path)
    assert robot.urdf == robot_from_files(robot.files, "a recording").urdf == "<robot/>"
    path.write_text(text.replace("arm.urdf", "arm\\u0000.urdf"))
    with pytest.raises(BadInputError, match="cannot be read: embedded null byte"):
        load_robot(path)


def test_errors_have_data_and_one_printable_line():
    error = RobotIdimError("does nothing", place="a.toml", key="b.c", value=[1, 2], expected="d")
    assert str(error) == "a.toml: b.c = [1, 2]: does nothing: expected d"
    assert (error.place, error.key, error.value, error.expected) == ("a.toml", "b.c", [1, 2], "d")
    assert (
        str(RobotIdimError(place="a.toml", key="b", value=None, expected="c"))
        == "a.toml: b is missing: expected c"
    )
    with_advice = RobotIdimError("x rows", place="a.toml", key="b", advice="Use c")
    assert str(with_advice) == "a.toml: b: x rows. Use c."
    bare = pickle.loads(pickle.dumps(error))  # as one process hands it to another
    assert (str(bare), bare.key, bare.value) == (str(error), "b.c", [1, 2])
    assert str(RobotIdimError("a\nb\r\n\x1b[2Jc\udcff µ")) == "a b �[2Jc� µ"
    assert one_line("  two  words ") == "two words"


def test_only_complete_file_replaces_old_one(tmp_path, monkeypatch):
    synced: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda _: synced.append((tmp_path / "out").read_text()))
    path = tmp_path / "out"
    path.write_text("old")
    with pytest.raises(UnicodeEncodeError), atomic_write(path) as partial:
        partial.write_text("half, then \udcff", encoding="utf-8")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert path.read_text() == "old"
    with atomic_write(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert (path.read_text(), synced) == ("new", ["old"])


def test_invalid_file_locations(tmp_path):
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe")  # stands for any device, which a mistake here would replace
    for path, message in (
        (tmp_path, "a folder or a device cannot be replaced"),
        (tmp_path / "pipe", "a folder or a device cannot be replaced"),
        (Path(), "the path has no file name"),
        (tmp_path / "none" / "out", "No such file or directory"),
        (tmp_path / "file" / "out", "Not a directory"),
    ):
        with pytest.raises(BadInputError, match=message), atomic_write(path) as partial:
            partial.write_text("new")
    assert {p.name for p in tmp_path.iterdir()} == {"file", "pipe"}
    assert (tmp_path / "pipe").is_fifo()


def test_input_is_not_replaced_under_any_name(tmp_path):
    (tmp_path / "in").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "in")
    (tmp_path / "hard link").hardlink_to(tmp_path / "in")
    for out in (tmp_path / "in", tmp_path / "link", tmp_path / "." / "in", tmp_path / "hard link"):
        with pytest.raises(BadInputError, match="the output is also an input"):
            refuse_clash([tmp_path / "missing", tmp_path / "in", None], out)
    refuse_clash([tmp_path / "in"], None, tmp_path / "out", tmp_path / "other")
    with pytest.raises(BadInputError, match="out: two outputs have this name"):
        refuse_clash([tmp_path / "in"], tmp_path / "out", None, tmp_path / "." / "out")


@pytest.mark.parametrize(
    ("lines", "key", "value"),
    [
        ("sample_rate_hz = 1000.0", "sample_rate_hz", 1000.0),
        ("position_gain = [1.0, 1.0]", "position_gain", [1.0, 1.0]),
        ('velocity_estimate = "exact"', "velocity_estimate", "exact"),
        ('structure = "pd"\nintegral_gain = [1.0, 1.0]', "integral_gain", [1.0, 1.0]),
    ],
)
def test_unused_controller_keys_are_refused(tmp_path, lines, key, value):
    before, after = (REPLAY / "scara" / "robot.toml").read_text().split("[controller]")
    path = tmp_path / "robot.toml"
    path.write_text(
        f"{before}[controller]\nbandwidth_hz = 5.0\n{lines}\n{after[after.index('[bus]') :]}"
    )
    with pytest.raises(BadInputError) as caught:
        load_robot(path)
    assert (caught.value.key, caught.value.value) == (f"controller.{key}", value)
    assert robot_from_files({"robot.toml": path.read_bytes()}, "log.mcap").n == 2
