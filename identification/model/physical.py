"""What a physical robot asks of its standard parameters: which are a link's, which combinations must be positive."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import PhysicalParameters, link_parameters, pseudo_inertia
from .inverse import FROM_PINOCCHIO, LINK, InverseModel
from .joint_terms import SHAPES, JointTerm

DENSITY = 1000.0  # kg/m³ of a plausible link, motor and hollows included
SLENDERNESS, RADIUS_M = 0.2, (0.05, 0.08)  # its radius: a share of its length, within these
LEAST_EIGENVALUE = 1e-4  # of a description's pseudo-inertia with a diagonal of ones: below it is no body's
ROTOR_SHARE, FRICTION = 0.1, 0.01  # to start from: of the link's ZZ, and N m or N m s
SAME_FRAMES = 1e-6  # m and parts of a rotation: two descriptions of one robot give their lengths to fewer digits
POSES, SEED = 4, 11  # at which the frames of two descriptions are compared
DISSIPATING = ("viscous", "coulomb", *SHAPES)  # what takes energy; constant offsets do not
RESISTING = ("rotor", "viscous", "coulomb")  # kinds of terms that no robot has below zero


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpectedLinks:
    """What is expected of the links before anything is measured.

    Attributes:
        links: (n, 10) XX XY XZ YY YZ ZZ MX MY MZ M in the frames of the model's links.
        sources: by link, where they are from: `[parameters]`, `URDF` or `plausible`.
    """

    links: Array
    sources: tuple[str, ...]


def expected_links(idm: InverseModel, prior: InverseModel | None = None) -> ExpectedLinks:
    """The links of `prior`, another description of the robot, or of the model's own.

    A link is that of the description's `[parameters]`, else of its URDF, else a plausible one: a rod from its joint to the
    next. The frames of `prior` may be others, as those of a URDF are for a robot of DH rows.

    Raises
    ------
    IdentificationError : where `prior` has other joints, or its links do not move as those of the model.
    """
    of = idm if prior is None else prior
    values = np.array([of.robot.parameters.get(name, 0.0) for name in of.names])
    found = [_expected_link(of, j, values[columns]) for j, columns in enumerate(link_columns(of))]
    links = np.array([link for link, _ in found])
    if prior is not None:
        T = _frames_of(idm, prior)
        links = link_parameters(T @ pseudo_inertia(links) @ T.transpose(0, 2, 1))
    return ExpectedLinks(links=links, sources=tuple(source for _, source in found))


def link_columns(idm: InverseModel) -> NDArray[np.intp]:
    """Columns (n, 10) of XX XY XZ YY YZ ZZ MX MY MZ M of each link."""
    place = {source: c for c, source in enumerate(idm.sources) if not isinstance(source, JointTerm)}
    return np.array([[place[j, i] for i in range(len(LINK))] for j in range(idm.robot.n)])


def friction_alone(idm: InverseModel, columns: NDArray[np.intp], j: int, v: Array, load: Array) -> Array:
    """Friction (k, b) of joint j per unit of the parameters `columns` (b,), offsets apart, where it moves alone.

    `v` (k,) are its speeds, `load` (k,) the sizes of the links' torque at it.
    """
    alone, still = np.zeros((len(v), idm.robot.n)), np.zeros((len(v), idm.robot.n))
    alone[:, j] = v
    G = np.zeros((len(v), len(columns)))
    for i, column in enumerate(columns):
        term = idm.sources[column]
        if isinstance(term, JointTerm) and term.kind in DISSIPATING and j in term.rows:
            G[:, i] = np.sign(v) * load if term.kind == "load" else term.entry(j, alone, still)
    return G


def physical_parameters(
    idm: InverseModel, prior: InverseModel | None = None, *, strict: bool = False
) -> PhysicalParameters:
    """What a physical robot asks of the standard parameters of a model.

    Links are expected as `expected_links` has them. The own rotor inertia, viscous and Coulomb friction of each motor and each
    joint must be positive. With a coupled wrist a joint's parameter counts a motor's share: Ia5 - Ia6, Fv5 - Fvm6, Fv6 - Fvm6.
    Where the description's own values deny such a difference (as Fv6 = 0.69, Fvm6 = 0.8 of the TX40 do), the joint's parameter
    alone must be positive; not if `strict`.
    """
    source = idm if prior is None else prior
    values = np.array([source.robot.parameters.get(name, 0.0) for name in idm.names])
    links, start = link_columns(idm), np.zeros(idm.p)
    start[links] = expected_links(idm, prior).links
    rows, combinations = _combinations(idm, np.zeros(idm.p) if strict else values)
    first = combinations @ values
    for i, c in enumerate(rows):
        term = idm.sources[c]
        if first[i] <= 0 and isinstance(term, JointTerm):
            ZZ = start[links[int(term.rows[-1]), LINK.index("ZZ")]]
            first[i] = ROTOR_SHARE * ZZ if term.kind == "rotor" else FRICTION
    start[rows] = np.linalg.solve(combinations[:, rows], first) if len(rows) else first
    return PhysicalParameters(links=links, prior=pseudo_inertia(start[links]), combinations=combinations, start=start)


def _combinations(idm: InverseModel, values: Array) -> tuple[list[int], Array]:
    """Columns (m,) of rotors and friction, and the combinations (m, p), one for each of them."""
    terms = {c: s for c, s in enumerate(idm.sources) if isinstance(s, JointTerm) and s.kind in RESISTING}
    own = {(s.kind, int(s.rows[0])): c for c, s in terms.items() if len(s.rows) == 1 and s.side == 0}
    A = np.zeros((idm.p, idm.p))
    A[list(terms), list(terms)] = 1.0
    for c, term in terms.items():
        for j in np.flatnonzero(term.given_away):
            A[own[term.kind, int(j)], c] -= term.given_away[j]
    denied = (A @ values <= 0) & (values > 0)
    A[denied] = np.eye(idm.p)[denied]
    return list(terms), A[list(terms)]


def _expected_link(idm: InverseModel, j: int, described: Array) -> tuple[Array, str]:
    """Ten parameters of link j: those described, those of the URDF, or those of a rod to the next joint; and which of them."""
    inertia = idm.model.inertias[j + 1]
    of_urdf = np.asarray(inertia.toDynamicParameters())[list(FROM_PINOCCHIO)]
    for parameters, source in ((described, "[parameters]"), (of_urdf, "URDF")):
        if is_a_body(parameters):
            return np.array(parameters), source
    after = [k for k in range(len(idm.model.parents)) if k > 0 and idm.model.parents[k] == j + 1]
    along = np.array(idm.model.jointPlacements[after[0]].translation) if after else np.zeros(3)
    length = float(np.linalg.norm(along))
    radius = float(np.clip(SLENDERNESS * length, *RADIUS_M))
    mass = DENSITY * np.pi * radius**2 * (length + 2 * radius)
    spread = np.outer(along, along) / 12 + radius**2 / 4 * np.eye(3)  # second moments over the mass, about the middle
    about_middle = mass * (np.trace(spread) * np.eye(3) - spread)
    rod = pin.Inertia(mass, along / 2, about_middle)
    return np.asarray(rod.toDynamicParameters())[list(FROM_PINOCCHIO)], "plausible"


def _frames_of(idm: InverseModel, prior: InverseModel) -> Array:
    """T (n, 4, 4): coordinates in the prior's link frames to those in the model's, which must be the same at all positions."""
    joints, others = idm.robot.joints, prior.robot.joints
    if [j.type for j in joints] != [j.type for j in others]:
        raise IdentificationError(
            place=f"prior {prior.robot.name}",
            key="joints",
            value=", ".join(j.type for j in others),
            expected=", ".join(j.type for j in joints),
        )
    q = np.random.default_rng(SEED).uniform(-1.0, 1.0, size=(POSES, idm.robot.n))
    (at, turned), (at_prior, turned_prior) = idm.placements(q), prior.placements(q)
    back = turned.transpose(0, 1, 3, 2)
    T = np.zeros((POSES, idm.robot.n, 4, 4))
    T[..., :3, :3], T[..., 3, 3] = back @ turned_prior, 1.0
    T[..., :3, 3] = np.einsum("knij,knj->kni", back, at_prior - at)
    off = np.abs(T - T[0]).max(axis=(0, 2, 3)) > SAME_FRAMES
    if off.any():
        raise IdentificationError(
            "its link moves differently than that of the fit",
            place=f"prior {prior.robot.name}",
            key="joint",
            value=others[int(off.argmax())].name,
            expected="the same base frame, axes, lengths and zeros",
        )
    return np.asarray(T[0])


def is_a_body(parameters: Array, least: float = LEAST_EIGENVALUE) -> bool:
    """Whether a body of positive density has these ten parameters: its pseudo-inertia, scaled, has no lower eigenvalue."""
    P = pseudo_inertia(parameters)
    diagonal = np.diag(P)
    if not (diagonal > 0).all():
        return False
    return float(np.linalg.eigvalsh(P / np.sqrt(np.outer(diagonal, diagonal))).min()) > least
