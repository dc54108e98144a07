"""Sets of friction terms: by joint, as a description states them, and as the parameters they stand for."""

from collections.abc import Sequence
from dataclasses import replace

import msgspec

from acquisition.robot import FrictionTerm, Joint, Robot

from ..model import BaseParameters, InverseModel, JointTerm

USUAL: tuple[FrictionTerm, ...] = ("viscous", "coulomb", "offset")
TRIED: tuple[FrictionTerm, ...] = ("asymmetric", "root", "load", "stribeck")  # in the order of a description's list
TermSet = tuple[frozenset[FrictionTerm], ...]  # by joint, what it has beside the usual terms


def usual_terms(joint: Joint) -> tuple[FrictionTerm, ...]:
    """The terms that a joint has in any set: those of viscous, coulomb and offset that are described.

    Friction that is two for the two directions has an offset in it: in its place stands friction that is one, and an offset.
    """
    described = ("viscous", "coulomb", "offset") if joint.one_sided else joint.terms
    return tuple(term for term in USUAL if term in described)


def tried_terms(joint: Joint) -> frozenset[FrictionTerm]:
    """What is tried beside the usual terms: Stribeck friction where its speed is stated."""
    return frozenset(term for term in TRIED if term != "stribeck" or joint.si("stribeck_speed") is not None)


def described_terms(robot: Robot, terms: TermSet) -> tuple[tuple[FrictionTerm, ...], ...]:
    """By joint, the list of terms that a description has for the set."""
    return tuple(
        (*usual_terms(joint), *(term for term in TRIED if term in more))
        for joint, more in zip(robot.joints, terms, strict=True)
    )


def with_terms(robot: Robot, terms: TermSet) -> Robot:
    """The robot with these friction terms in place of the described ones."""
    lists = described_terms(robot, terms)
    joints = (
        msgspec.structs.replace(joint, friction=friction, viscous=None, coulomb=None, offset=None)
        for joint, friction in zip(robot.joints, lists, strict=True)
    )
    return replace(robot, joints=tuple(joints))


def parameters_of(model: InverseModel, base: BaseParameters) -> dict[tuple[int, FrictionTerm], tuple[str, ...]]:
    """By joint and tried term, its base parameters: two where a motor turns with several joints."""
    found: dict[tuple[int, FrictionTerm], tuple[str, ...]] = {}
    for name, column in zip(base.names, base.columns, strict=True):
        source = model.sources[column]
        for term in TRIED:
            if isinstance(source, JointTerm) and source.kind == term:
                key = int("".join(filter(str.isdigit, name))) - 1, term
                found[key] = (*found.get(key, ()), name)
    return found


def everywhere(joints: Sequence[Joint], kinds: frozenset[FrictionTerm]) -> TermSet:
    """These terms at all joints that may have them."""
    return tuple(kinds & tried_terms(joint) for joint in joints)
