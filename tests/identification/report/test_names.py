"""Names of parameters are read as they were built, whatever recordings and motors are called."""

import pytest
from conftest import robot_named

from acquisition.robot import FRICTION
from identification.model import InverseModel, base_parameters
from identification.report import (
    base_name,
    gain_name,
    is_base,
    is_gain,
    is_load,
    is_own,
    meaning_of,
    motor_of,
    own_name,
    payload_name,
    payload_parameter,
    recording_of,
)

ODD = ("A", "r1@night", "10:30", "a@b:c", "a:b@c", "mu")


@pytest.mark.parametrize("label", ODD)
@pytest.mark.parametrize("base", ["Fv1", "mu2", "XXR3"])
def test_per_recording_parameters(base, label):
    name = own_name(base, label)
    assert (base_name(name), recording_of(name)) == (base, label)
    assert [bool(question(name)) for question in (is_base, is_own, is_gain)] == [True, True, False]
    assert bool(is_load(name)) == bool(is_load(base)) == (base == "mu2")


@pytest.mark.parametrize("label", ODD)
def test_payloads_and_gains(label):
    payload, gain = payload_name("MXR", label), gain_name(label)
    assert (payload_parameter(payload), motor_of(gain)) == ("MXR", label)
    assert [bool(is_gain(name)) for name in (payload, gain)] == [False, True]
    for name in (payload, gain):
        assert (base_name(name), recording_of(name)) == (name, "")
        assert not any(question(name) for question in (is_base, is_own, is_load))


def test_common_parameters():
    assert (base_name("Off1"), recording_of("Off1")) == ("Off1", "")
    assert is_base("Off1")
    assert not is_own("Off1")


def test_every_parameter_has_a_meaning():
    """A new friction term needs one too."""
    names = [f"{x}1" for term in FRICTION.values() for x in (term.name, term.motor_name) if x] + [
        name
        for robot in ("tx40", "scara", "emps")
        for name in base_parameters(InverseModel(robot_named(robot))).names
    ]
    assert [name for name in names if not meaning_of(name, ["axis"] * 6)] == []
    assert (
        meaning_of("Fc2R@night", ["base", "axis"])
        == "Coulomb friction of axis in night (regrouped)"
    )
