"""Numbers of a URDF that are none: one line that says where, and nothing left out silently."""

import numpy as np
import pytest
from urdfs import urdf

from acquisition.errors import BadInputError
from identification.commands import main
from identification.export import read_chain, robot_of_chain
from identification.model import InverseModel

WHOLE = urdf()
PLACED = '<origin xyz="0.2 0 0.1" rpy="0.3 0 0.5"/>'
CENTRED = '<origin xyz="0.1 -0.02 0.03" rpy="0.1 0.2 -0.3"/>'


def made(tmp_path, text):
    (tmp_path / "arm.urdf").write_text(text)
    return read_chain(tmp_path / "arm.urdf", ("turn", "lift", "slide"))


@pytest.mark.parametrize(
    "text", ["0 0", "0 0 1 5", "a b c", "0,0,1", "nan 0 1", "inf 0 0", "", "1d0 0 0"]
)
@pytest.mark.parametrize(
    ("before", "after", "where", "key"),
    [
        ('<axis xyz="0 1 0"/>', '<axis xyz="{}"/>', "joint 'lift'", "axis xyz"),
        (PLACED, '<origin xyz="{}" rpy="0 0 0"/>', "joint '", "origin xyz"),
        (PLACED, '<origin rpy="{}"/>', "joint '", "origin rpy"),
        (CENTRED, '<origin xyz="{}"/>', "link '", "inertial origin xyz"),
        ('<mass value="1.5"/>', '<mass value="{}"/>', "link 'arm'", "inertial mass value"),
        ('ixy="0.001"', 'ixy="{}"', "link '", "inertial inertia ixy"),
    ],
)
def test_malformed_numbers_refused(tmp_path, capfd, text, before, after, where, key):
    """As text of the parser's own they would stand on stderr; it would leave out the inertial."""
    assert before in WHOLE
    robot = robot_of_chain(made(tmp_path, WHOLE))
    bad = WHOLE.replace(before, after.format(text))
    with pytest.raises(BadInputError) as caught:
        InverseModel(type(robot)(**{**vars(robot), "urdf": bad}))
    error = caught.value
    assert (error.key, error.value) == (key, text)
    assert f": URDF: {where}" in error.place
    (tmp_path / "arm.urdf").write_text(bad)
    assert main(["init", str(tmp_path / "arm.urdf"), "--joints", "turn,lift,slide"]) == 1
    printed = capfd.readouterr()
    assert printed.err.count("\n") == 1
    assert repr(text) in printed.err


@pytest.mark.parametrize("part", ["<mass value", "<inertia "])
def test_incomplete_inertial_reported(tmp_path, part):
    robot = robot_of_chain(made(tmp_path, WHOLE))
    bad = WHOLE.replace(part, part.replace("<", "<other_"))
    with pytest.raises(BadInputError) as caught:
        InverseModel(type(robot)(**{**vars(robot), "urdf": bad}))
    assert caught.value.value is None
    assert caught.value.expected == "a finite number"


def test_irrelevant_elements_ignored(tmp_path, capfd):
    """Pictures, a limit of a locked joint, plugins: the model is the same without a word."""
    odd = '<visual><origin xyz="a"/><geometry><box size="1 x"/></geometry></visual>'
    text = WHOLE.replace("</inertial></link>", f"</inertial>{odd}</link>")
    text = text.replace("</robot>", '<material name="red"/><gazebo><limit/></gazebo></robot>')
    assert text != WHOLE
    motion = np.random.default_rng(3).uniform(-1, 1, (3, 20, 3))
    expected, found = (
        InverseModel(robot_of_chain(made(tmp_path, one))).regressor(*motion)
        for one in (WHOLE, text)
    )
    np.testing.assert_array_equal(found, expected)
    assert capfd.readouterr().err == ""
