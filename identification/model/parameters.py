"""The parameters of a robot: base parameters, and prior knowledge of the standard parameters.

A priori values of links are those of the description, of its URDF, or follow from the links'
lengths. A payload is given too, and belongs to the last link.

Base parameters are the fewest that give the inverse dynamic model. They are found numerically
(Gautier1991). The torque W chi of a robot never shows all its standard parameters chi. Some columns
of W are zero at every state, because their parameter moves no joint, such as the mass of the first
link. Others are combinations of columns: a rotor inertia acts as the link's ZZ does. This depends
on the robot alone, so W at random states shows it to rounding. Its columns, scaled to norm one, are
factored, W = Q R:

    |R_cc| > 0    column c is independent of the columns before it: a base parameter
    |R_cc| = 0    W_c = W_independent C_c: its parameter is regrouped into others

With W_dependent = W_independent C the torque is W_independent (chi_independent + C chi_dependent),
hence beta = K chi with K = [1 C] in the order of the columns.

The kept columns depend on the order. From the base outwards, links first, it gives the names that
the literature uses: ZZ1R, XX2R, ...; R marks a regrouped parameter. Further friction terms, which a
fit may leave out, are not regrouped.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from acquisition.errors import COMMAND_LINE, Location, listed
from acquisition.robot import Payload

from ..arrays import Array, Bools, Ints
from ..estimation import link_parameters, pseudo_inertia
from ..report import is_load
from .inverse import FROM_PINOCCHIO, LINK, InverseModel, link_columns
from .joint_terms import SHAPES

STATES = 200  # random states; 200 n rows are several times the number of columns
TOLERANCE = 1e-9  # of a column's norm; the residual of a dependent column is rounding
MIN_COEFFICIENT = 1e-8  # of C; less is rounding
SEED = 2014
BALL_RADIUS_M = 0.1  # of the ball whose inertia about its centre of mass a payload gets
DENSITY = 1000.0  # kg/m³ of a plausible link, including motor and cavities
SLENDERNESS, RADIUS_M = 0.2, (0.05, 0.08)  # its radius over its length; limits of the radius
ROUNDING = 1e-12  # of the largest a priori value; less is rounding
MIN_EIGENVALUE = 1e-4  # of the pseudo-inertia of a rigid body, scaled to a diagonal of ones
MAX_FRAME_DIFFERENCE = 1e-6  # m, and entries of rotations, of two descriptions of one robot
POSES, POSES_SEED = 4, 11  # poses at which the frames of two descriptions are compared


@dataclass(frozen=True, kw_only=True, eq=False)
class BaseParameters:
    """The base parameters beta = K chi of the standard parameters chi.

    Attributes:
        names: (b,) names, with the suffix R if other parameters are regrouped into it.
        expressions: (b,) each as a sum of standard parameters.
        units: (b,) SI units; A or V replaces N m if the drive gain is not known.
        columns: (b,) their columns in the regressor: W_base = W_standard[:, columns].
        K: (b, p) regrouping matrix.
        masses: (n,) columns of the links' masses M1 ... Mn.
        links: (b,) mask of the parameters of links, which may include a rotor inertia, as in ZZ1R.
    """

    names: tuple[str, ...]
    expressions: tuple[str, ...]
    units: tuple[str, ...]
    columns: Ints
    K: Array

    masses: Ints
    links: Bools

    @cached_property
    def b(self) -> int:
        """Number of base parameters."""
        return len(self.names)

    def standard_parameters(self, beta: Array) -> Array:
        """Return standard parameters chi (p,) with K chi = beta.

        All links whose masses are free have the same mass. Every chi with the same beta gives the
        same motion.
        """
        # Pinocchio divides by masses. Free ones are larger than those of beta, so that no regrouped
        # mass becomes zero.
        chi, given = np.zeros(self.K.shape[1]), beta[np.isin(self.columns, self.masses)]
        chi[np.setdiff1d(self.masses, self.columns)] = 1.0 + np.abs(given).max(initial=0.0)
        chi[self.columns] = beta - self.K @ chi
        return chi

    def without(self, names: Collection[str]) -> "BaseParameters":
        """Return a copy without the given friction terms, which must not be regrouped."""
        others = [i for i, name in enumerate(self.names) if name not in names]
        return replace(
            self,
            names=tuple(self.names[i] for i in others),
            expressions=tuple(self.expressions[i] for i in others),
            units=tuple(self.units[i] for i in others),
            columns=self.columns[others],
            K=self.K[others],
            links=self.links[others],
        )


def load_parameters(base: BaseParameters) -> tuple[str, ...]:
    """Return the names of load-dependent friction, mu1, mu2, ..., in which IDM is not linear."""
    return tuple(filter(is_load, base.names))


def base_parameters(dynamics: InverseModel) -> BaseParameters:
    """Find the base parameters of a robot from its regressor at random states (Gautier1991)."""
    rng = np.random.default_rng(SEED)
    q, dq, ddq = (rng.uniform(-np.pi, np.pi, size=(STATES, dynamics.robot.n)) for _ in range(3))
    W = dynamics.regressor(q, dq, ddq).reshape(-1, dynamics.p)
    norms = np.linalg.norm(W, axis=0)
    shapes = [c for c, term in dynamics.terms.items() if term.kind in SHAPES]
    # Links come first, from the base outwards, so that rotors and friction are regrouped into a
    # link's parameter and not the other way round.
    order = sorted(range(dynamics.p), key=lambda c: (not dynamics.of_links[c], c))
    present = [c for c in order if norms[c] > TOLERANCE * norms.max() and c not in shapes]
    independent, regrouping = _regroup(W[:, present] / norms[present], norms, np.array(present))
    # Further friction terms are not regrouped, because a fit may leave them out.
    independent = np.r_[independent, np.array(shapes, dtype=np.intp)]
    K = np.r_[regrouping, np.zeros((len(shapes), dynamics.p))]
    K[np.arange(len(independent)), independent] = 1.0
    by_column = np.argsort(independent)
    K, columns = K[by_column], independent[by_column]
    names = dynamics.names
    return BaseParameters(
        names=tuple(
            names[c] + "R" * bool(np.count_nonzero(row) > 1)
            for c, row in zip(columns, K, strict=True)
        ),
        expressions=tuple(
            _expression(row, int(c), names) for row, c in zip(K, columns, strict=True)
        ),
        units=tuple(dynamics.units[c] for c in columns),
        columns=columns,
        K=K,
        masses=link_columns(dynamics)[:, LINK.index("M")],
        links=dynamics.of_links[columns],
    )


def _regroup(scaled: Array, norms: Array, columns: Ints) -> tuple[Ints, Array]:
    """Return the independent columns (b,), and the parameters regrouped into each, (b, p).

    Parameters
    ----------
    scaled : (r, k) columns of a regressor, scaled to norm one.
    norms : (p,) norms of all columns.
    columns : (k,) which columns these are.
    """
    diagonal = np.abs(np.diag(np.linalg.qr(scaled, mode="r")))
    keep = diagonal > TOLERANCE * diagonal.max()
    independent, dependent = columns[keep], columns[~keep]
    regrouping = np.zeros((len(independent), len(norms)))
    if len(dependent):
        C = np.linalg.lstsq(scaled[:, keep], scaled[:, ~keep])[0]
        C = C * norms[dependent] / norms[independent][:, None]
        C[np.abs(C) < MIN_COEFFICIENT] = 0.0
        regrouping[:, dependent] = C
    return independent, regrouping


def _expression(row: Array, own: int, names: tuple[str, ...]) -> str:
    """Return an expression such as `ZZ2 + Ia2 + 0.0506 (M3 + M4)`.

    The parameter itself comes first; equal coefficients are in one bracket.
    """
    groups: dict[float, list[str]] = {}
    for c in [own, *(int(c) for c in np.flatnonzero(row) if c != own)]:
        groups.setdefault(float(f"{row[c]:.6g}"), []).append(names[c])
    text = ""
    for coefficient, members in groups.items():
        inside = " + ".join(members)
        factor = "" if abs(coefficient) == 1.0 else f"{abs(coefficient):.6g} "
        if len(members) > 1 and (factor or coefficient < 0):
            inside = f"({inside})"
        text += (" - " if coefficient < 0 else " + " if text else "") + factor + inside
    return text


def known_parameters(dynamics: InverseModel) -> Array:
    """Return standard parameters chi (p,) of `[parameters]` in the description.

    Parameters that are not given are zero.
    """
    values, names = dynamics.robot.parameters, dynamics.names
    place = Location(f"robot {dynamics.robot.name}")
    place.require(
        values,
        text="has no [parameters], which simulations need",
        advice="Write them with `robot-identify export FIT.json --toml ROBOT.toml`, or let "
        "`robot-identify init` read a URDF with inertials",
    )
    for name, value in values.items():
        place.require(
            name in names,
            f"parameters.{name}",
            value,
            f"one of {', '.join(names[:3])} ... {names[-1]}",
            text="is not a standard parameter of this robot",
        )
    return np.array([values.get(name, 0.0) for name in names])


def described_parameters(dynamics: InverseModel, base: BaseParameters) -> Array:
    """Return base parameters K chi (b,) of `[parameters]` in the description."""
    return np.asarray(base.K @ known_parameters(dynamics))


def expected_links(
    idm: InverseModel, prior: InverseModel | None = None
) -> tuple[Array, tuple[str, ...]]:
    """Return the a priori parameters of the links.

    They are those of `[parameters]`, else of the `URDF`, else `plausible`: of a rod from the joint
    to the next.

    Parameters
    ----------
    idm : the robot.
    prior : another description of the robot, whose links are used; its link frames may differ, as
        those of a URDF differ from DH rows. None for its own.

    Returns
    -------
    Parameters (n, 10), XX XY XZ YY YZ ZZ MX MY MZ M in the model's link frames, and the source of
    each link.

    Raises
    ------
    BadInputError : `prior` has other joints, or its links move differently.
    """
    of = idm if prior is None else prior
    values = np.array([of.robot.parameters.get(name, 0.0) for name in of.names])
    of_urdf = of.link_parameters()
    found, sources = zip(
        *(
            _expected_link(of, j, values[columns], of_urdf[j])
            for j, columns in enumerate(link_columns(of))
        ),
        strict=True,
    )
    links = np.array(found)
    if prior is not None:
        T = _frames_of(idm, prior)
        links = link_parameters(T @ pseudo_inertia(links) @ T.transpose(0, 2, 1))
    return links, sources


def base_prior(
    idm: InverseModel, base: BaseParameters, prior: InverseModel | None = None
) -> tuple[dict[str, float], str]:
    """Return a priori base parameters K chi of links alone, by name, and their source.

    They are those of `expected_links` without plausible values.
    """
    (links, sources), chi = expected_links(idm, prior), np.full(idm.p, np.nan)
    chi[link_columns(idm)] = np.where((np.array(sources) == "plausible")[:, None], np.nan, links)
    known, beta = base.links & ~((base.K != 0) @ np.isnan(chi)), base.K @ np.nan_to_num(chi)
    beta[np.abs(beta) < ROUNDING * np.abs(beta).max()] = 0.0
    found = {name: float(x) for name, x, k in zip(base.names, beta, known, strict=True) if k}
    return found, "URDF" if "URDF" in sources else "[parameters]"


def payload_parameters(model: InverseModel, payload: Payload) -> Array:
    """Return the payload's XX XY XZ YY YZ ZZ MX MY MZ M (10,) in the last link's frame.

    The payload is a ball. Without a centre of mass it is at the origin of the payload's frame.

    Raises
    ------
    BadInputError : the mass is unknown, or the frame is not a fixed link that the last joint
        carries.
    """
    mass_kg = COMMAND_LINE.given(
        payload.mass_kg, "payload", str(payload), text="has no mass", advice="Give its mass in kg"
    )
    placement = pin.SE3.Identity()
    if payload.frame is not None:
        links = {
            frame.name: frame.placement
            for frame in model.model.frames
            if frame.parentJoint == model.robot.n and frame.type == pin.FrameType.BODY
        }
        Location(f"robot {model.robot.name}").require(
            payload.frame in links,
            "payload.frame",
            payload.frame,
            f"a link on joint {model.robot.joints[-1].name}: {listed([*links])}",
        )
        placement = links[payload.frame]
    body = pin.Inertia(
        mass_kg,
        np.array(payload.center_of_mass_m or (0.0, 0.0, 0.0)),
        0.4 * mass_kg * BALL_RADIUS_M**2 * np.eye(3),
    )
    return np.asarray(placement.act(body).toDynamicParameters())[list(FROM_PINOCCHIO)]


def add_payload(model: InverseModel, parameters: Array, payload: Payload) -> Array:
    """Return standard parameters (p,) of the robot with the payload, from those without it."""
    out = np.array(parameters, dtype=float)
    out[link_columns(model)[-1]] += payload_parameters(model, payload)
    return out


def is_a_body(parameters: Array, least: float = MIN_EIGENVALUE) -> bool:
    """Test whether a rigid body with positive mass density can have these parameters (10,).

    The eigenvalues of its scaled pseudo-inertia must be greater than `least`.
    """
    P = pseudo_inertia(parameters)
    diagonal = np.diag(P)
    return bool(
        (diagonal > 0).all()
        and np.linalg.eigvalsh(P / np.sqrt(np.outer(diagonal, diagonal))).min() > least
    )


def _expected_link(
    idm: InverseModel, j: int, described: Array, of_urdf: Array
) -> tuple[Array, str]:
    """Return the a priori parameters (10,) of link j and their source."""
    for parameters, source in ((described, "[parameters]"), (of_urdf, "URDF")):
        if is_a_body(parameters):
            return np.array(parameters), source
    # to the next joint, if there is one
    along, *_ = [*idm.joint_frames[0][np.equal(idm.parents, j + 1)], np.zeros(3)]
    length = float(np.linalg.norm(along))
    radius = float(np.clip(SLENDERNESS * length, *RADIUS_M))
    mass = DENSITY * np.pi * radius**2 * (length + 2 * radius)
    # Second moments of a cylinder over its mass, about the middle.
    spread = np.outer(along, along) / 12 + radius**2 / 4 * np.eye(3)
    about_middle = mass * (np.trace(spread) * np.eye(3) - spread)
    rod = pin.Inertia(mass, along / 2, about_middle)
    return np.asarray(rod.toDynamicParameters())[list(FROM_PINOCCHIO)], "plausible"


def _frames_of(idm: InverseModel, prior: InverseModel) -> Array:
    """Return T (n, 4, 4) from the prior's link frames to the model's.

    T must not depend on the position.
    """
    joints, others = idm.robot.joints, prior.robot.joints
    Location(f"prior {prior.robot.name}").require(
        [j.type for j in joints] == [j.type for j in others],
        "joints",
        ", ".join(j.type for j in others),
        ", ".join(j.type for j in joints),
    )
    q = np.random.default_rng(POSES_SEED).uniform(-1.0, 1.0, size=(POSES, idm.robot.n))
    (at, turned), (at_prior, turned_prior) = idm.placements(q), prior.placements(q)
    back, T = turned.transpose(0, 1, 3, 2), np.zeros((POSES, idm.robot.n, 4, 4))
    T[..., :3, :3], T[..., 3, 3] = back @ turned_prior, 1.0
    T[..., :3, 3] = np.einsum("knij,knj->kni", back, at_prior - at)
    differs = np.abs(T - T[0]).max(axis=(0, 2, 3)) > MAX_FRAME_DIFFERENCE
    Location(f"prior {prior.robot.name}").require(
        not differs.any(),
        "joint",
        others[int(differs.argmax())].name,
        text="its link moves differently from that of the fit",
        advice="Use the same base frame, axes, lengths and zeros",
    )
    return np.asarray(T[0])
