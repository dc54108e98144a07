"""Standard parameters as simulators take them: bodies, armatures, damping, dry friction, motors that turn several joints.

A joint's own Ia, Fv count the share of a motor that turns with it (Ia5 of the TX40 counts Ia6): it is taken off here. What is
left of friction may be below zero where the joints that share motors feed no energy together.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError
from ..model import RESISTING, InverseModel, JointTerm, is_a_body, link_columns, requirements

LEAST = 1e-12  # eigenvalue of a scaled pseudo-inertia: below it a link is no body


@dataclass(frozen=True, kw_only=True, eq=False)
class Coupling:
    """A motor that turns with several joints, at the speed row·dq (n,): its armature, damping and friction loss, SI."""

    name: str
    row: Array
    armature: float = 0.0
    damping: float = 0.0
    frictionloss: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Mechanism:
    """A robot with values for all of its standard parameters.

    Attributes:
        model, chi: inverse model and its standard parameters (p,), SI.
        links: (n, 10) XX XY XZ YY YZ ZZ MX MY MZ M of each link, about the origin of its frame.
        armature, damping, frictionloss: (n,) of the joints alone, SI.
        couplings: motors that turn with several joints.
        offset: (n,) constant torque, N m or N.
        others: columns of friction terms that are neither viscous nor dry, or not the same both ways.
    """

    model: InverseModel
    chi: Array
    links: Array
    armature: Array
    damping: Array
    frictionloss: Array
    couplings: tuple[Coupling, ...]
    offset: Array
    others: tuple[int, ...]


def mechanism_of(model: InverseModel, chi: Array, place: str) -> Mechanism:
    """Take the standard parameters chi (p,) of a model apart.

    Raises `IdentificationError`: where a link is no body, a rotor inertia is negative, or friction feeds energy:
    simulators take that without a word. `place` names the parameters' file.
    """
    n = model.robot.n
    own = {kind: np.zeros(n) for kind in RESISTING}
    coupled: dict[int, dict[str, float]] = {}
    rows: dict[int, Array] = {}
    offset, others = np.zeros(n), list[int]()
    for c, source in enumerate(model.sources):
        if not isinstance(source, JointTerm):
            continue
        if source.kind == "offset":
            offset += chi[c] * source.direction
        elif source.kind not in RESISTING or source.side:
            others.append(c)
        elif np.count_nonzero(source.row) > 1:
            rows[source.joint] = source.row
            coupled.setdefault(source.joint, dict.fromkeys(RESISTING, 0.0))[source.kind] += float(chi[c])
            own[source.kind] -= chi[c] * source.given_away
        else:
            own[source.kind] += chi[c] * source.row
    made = Mechanism(
        model=model,
        chi=chi,
        links=chi[link_columns(model)],
        armature=own["rotor"],
        damping=own["viscous"],
        frictionloss=own["coulomb"],
        couplings=tuple(
            Coupling(
                name=model.robot.motors[m].name,
                row=rows[m],
                armature=values["rotor"],
                damping=values["viscous"],
                frictionloss=values["coulomb"],
            )
            for m, values in coupled.items()
        ),
        offset=offset,
        others=tuple(others),
    )
    _refuse_impossible(made, place)
    return made


def about_com(link: Array) -> tuple[float, Array, Array]:
    """Mass, centre of mass (3,) and XX XY XZ YY YZ ZZ (6,) about it, of a link's ten parameters (10,) about the origin."""
    mass = float(link[9])
    com = link[6:9] / mass
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, np.asarray(link[:6] - steiner[np.triu_indices(3)])


def _refuse_impossible(m: Mechanism, place: str) -> None:
    joints = [joint.name for joint in m.model.robot.joints]
    for j, link in enumerate(m.links):
        if not is_a_body(link, LEAST):
            problem = "no body of positive density has these inertias"
            key = f"link {j + 1}, of joint {joints[j]}"
            raise IdentificationError(problem, place=place, key=key, expected="the fit again with --consistent")
    for matrix, first, text in requirements(m.model, shaped=False):
        lowest = float(np.linalg.eigvalsh(matrix @ m.chi)[0])
        if lowest < -LEAST:
            raise IdentificationError(
                "a simulator would take it without a word, and gain energy",
                place=place,
                key=text,
                value=lowest,
                shown=f"{lowest:.4g} {first.unit}",
                expected="0 or more: the fit again with --consistent",
            )
