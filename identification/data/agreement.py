"""Whether recordings are of one robot: joints, links, motors and units agree; controllers and buses may differ."""

from collections.abc import Iterator, Sequence
from typing import Any, get_args

import numpy as np

from acquisition.robot import FrictionTerm, Joint, Robot

from ..errors import IdentificationError
from .signals import Signals

JOINT = ("name", "type", "dh", "zero_deg", "zero_m", "stribeck_speed_deg_s", "stribeck_speed_m_s", "rotor_inertia")
MOTOR = ("name", "ratio", "effort_unit", "drive_gain", "drive_gain_unit")


def check_one_robot(recordings: Sequence[Signals]) -> None:
    """Refuse recordings that are not of one robot, or one recording twice.

    Raises `IdentificationError` with the recording, the joint or motor, the value, and that of the first recording.
    """
    first, seen = recordings[0], {recordings[0].sha256: recordings[0].recording}
    for other in recordings[1:]:
        if other.sha256 and other.sha256 in seen:
            problem = f"holds the same as {seen[other.sha256]}"
            raise IdentificationError(problem, place=other.recording, expected="each recording once")
        seen[other.sha256] = other.recording
        if other.robot.n != first.robot.n:
            expected = f"{first.robot.n}, as in {first.recording}"
            raise IdentificationError(place=other.recording, key="joints", value=other.robot.n, expected=expected)
        for key, value, wanted in _compared(other.robot, first.robot):
            if value != wanted:
                expected = f"{wanted!r}, as in {first.recording}: recordings of one fit are of one robot"
                raise IdentificationError(place=other.recording, key=key, value=value, expected=expected)


def _compared(a: Robot, b: Robot) -> Iterator[tuple[str, Any, Any]]:
    """What must agree of two robots of as many joints: its place, and the value of each."""
    for mine, others in zip(a.joints, b.joints, strict=True):
        for name in JOINT:
            yield f"joint {mine.name}: {name}", getattr(mine, name), getattr(others, name)
        yield f"joint {mine.name}: friction", _friction(mine), _friction(others)
    for motor, other in zip(a.motors, b.motors, strict=True):
        for name in MOTOR:
            yield f"motor {motor.name}: {name}", getattr(motor, name), getattr(other, name)
    for key, x, y in (("gravity_m_s2", a.gravity, b.gravity), ("motor_matrix", a.R, b.R)):
        yield key, np.asarray(x).tolist(), np.asarray(y).tolist()
    same = "the same" if a.urdf == b.urdf else "another"
    yield "urdf", same, "the same"


def _friction(joint: Joint) -> tuple[str, ...]:
    """The friction terms of a joint, in one order: keys and lists that mean the same are the same."""
    terms = tuple(term for term in get_args(FrictionTerm) if term in joint.terms)
    return ("for each direction", *terms) if joint.one_sided else terms
