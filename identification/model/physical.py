"""What a physical robot asks of its standard parameters: which are a link's, which combinations must be positive."""

import numpy as np
import pinocchio as pin

from ..arrays import Array
from ..estimation import PhysicalParameters, pseudo_inertia
from .inverse import FROM_PINOCCHIO, LINK, InverseModel
from .joint_terms import JointTerm

DENSITY = 1000.0  # kg/m³ of a plausible link, motor and hollows included
SLENDERNESS, RADIUS_M = 0.2, (0.05, 0.08)  # its radius: a share of its length, within these
LEAST_EIGENVALUE = 1e-4  # of a description's pseudo-inertia with a diagonal of ones: below it is no body's
ROTOR_SHARE, FRICTION = 0.1, 0.01  # to start from: of the link's ZZ, and N m or N m s
RESISTING = ("rotor", "viscous", "coulomb")  # kinds of terms that no robot has below zero


def physical_parameters(idm: InverseModel) -> PhysicalParameters:
    """What a physical robot asks of the standard parameters of a model.

    A link is expected to be that of the description's `[parameters]`, else of its URDF, else a plausible one: a rod from its
    joint to the next. The own rotor inertia, viscous and Coulomb friction of each motor and each joint must be positive. With
    a coupled wrist a joint's parameter counts a motor's share: Ia5 - Ia6, Fv5 - Fvm6, Fv6 - Fvm6. Where the description's own
    values deny such a difference (as Fv6 = 0.69, Fvm6 = 0.8 of the TX40 do), the joint's parameter alone must be positive.
    """
    values = np.array([idm.robot.parameters.get(name, 0.0) for name in idm.names])
    place = {source: c for c, source in enumerate(idm.sources) if not isinstance(source, JointTerm)}
    links = np.array([[place[j, i] for i in range(len(LINK))] for j in range(idm.robot.n)])
    start = np.zeros(idm.p)
    start[links] = [_expected_link(idm, j, values[columns]) for j, columns in enumerate(links)]
    rows, combinations = _combinations(idm, values)
    first = combinations @ values
    for i, c in enumerate(rows):
        source = idm.sources[c]
        if first[i] <= 0 and isinstance(source, JointTerm):
            ZZ = start[links[int(source.rows[-1]), LINK.index("ZZ")]]
            first[i] = ROTOR_SHARE * ZZ if source.kind == "rotor" else FRICTION
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


def _expected_link(idm: InverseModel, j: int, described: Array) -> Array:
    """Ten parameters of link j: those described, those of the URDF, or those of a rod to the next joint."""
    inertia = idm.model.inertias[j + 1]
    of_urdf = np.asarray(inertia.toDynamicParameters())[list(FROM_PINOCCHIO)]
    for parameters in (described, of_urdf):
        if _is_a_body(parameters):
            return np.array(parameters)
    after = [k for k in range(len(idm.model.parents)) if k > 0 and idm.model.parents[k] == j + 1]
    along = np.array(idm.model.jointPlacements[after[0]].translation) if after else np.zeros(3)
    length = float(np.linalg.norm(along))
    radius = float(np.clip(SLENDERNESS * length, *RADIUS_M))
    mass = DENSITY * np.pi * radius**2 * (length + 2 * radius)
    spread = np.outer(along, along) / 12 + radius**2 / 4 * np.eye(3)  # second moments over the mass, about the middle
    about_middle = mass * (np.trace(spread) * np.eye(3) - spread)
    rod = pin.Inertia(mass, along / 2, about_middle)
    return np.asarray(rod.toDynamicParameters())[list(FROM_PINOCCHIO)]


def _is_a_body(parameters: Array) -> bool:
    P = pseudo_inertia(parameters)
    diagonal = np.diag(P)
    if not (diagonal > 0).all():
        return False
    return float(np.linalg.eigvalsh(P / np.sqrt(np.outer(diagonal, diagonal))).min()) > LEAST_EIGENVALUE
