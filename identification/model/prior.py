"""Standard parameters that are known before a fit: of links by the description, by its URDF or by
their lengths, and of a payload, which the last link carries.
"""

import numpy as np
import pinocchio as pin

from acquisition.errors import listed
from acquisition.robot import Payload

from ..arrays import Array
from ..errors import BadInputError
from ..estimation import link_parameters, pseudo_inertia
from .base import BaseParameters
from .inverse import FROM_PINOCCHIO, InverseModel, link_columns

BALL_RADIUS_M = 0.1  # of the ball that a payload is taken for: its inertia about its centre of mass
DENSITY = 1000.0  # kg/m³ of a plausible link, including motor and cavities
SLENDERNESS, RADIUS_M = 0.2, (0.05, 0.08)  # its radius over its length, and limits of the radius
ROUNDING = 1e-12  # of the largest a-priori value: smaller ones are rounding
MIN_EIGENVALUE = 1e-4  # of a physical pseudo-inertia, scaled to a diagonal of ones
MAX_FRAME_DIFFERENCE = 1e-6  # m and rotation entries, of two descriptions of one robot
POSES, SEED = 4, 11  # to compare the frames of two descriptions


def known_parameters(dynamics: InverseModel) -> Array:
    """Standard parameters chi (p,) of the description's `[parameters]`, zero if not stated."""
    values, names, place = dynamics.robot.parameters, dynamics.names, f"robot {dynamics.robot.name}"
    if not values:
        raise BadInputError(
            "no [parameters] to simulate with",
            place=place,
            expected="inertials in the URDF when `init` read it, or `export --toml` of a fit",
        )
    for name, value in values.items():
        if name not in names:
            raise BadInputError(
                "not a standard parameter of this robot",
                place=place,
                key=f"parameters.{name}",
                value=value,
                expected=f"such as {', '.join(names[:3])} ... {names[-1]}",
            )
    return np.array([values.get(name, 0.0) for name in names])


def described_parameters(dynamics: InverseModel, base: BaseParameters) -> Array:
    """Base parameters (b,) of the description's `[parameters]`: K chi."""
    return np.asarray(base.K @ known_parameters(dynamics))


def expected_links(
    idm: InverseModel, prior: InverseModel | None = None
) -> tuple[Array, tuple[str, ...]]:
    """A-priori links of `prior`, another description of the robot, or of the
    model's own description.

    Returns parameters (n, 10), XX XY XZ YY YZ ZZ MX MY MZ M in the model's link frames, and
    the source of each link.

    A link is from the description's `[parameters]`, else its `URDF`, else `plausible`: a rod from
    its joint to the next. The link frames of `prior` may differ, as those of a URDF from DH rows.
    Raises `BadInputError` if it has other joints or its links move differently.
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
    """A-priori base parameters K chi of links alone, by name, as `expected_links` without
    plausible values; their source.
    """
    (links, sources), chi = expected_links(idm, prior), np.full(idm.p, np.nan)
    chi[link_columns(idm)] = np.where((np.array(sources) == "plausible")[:, None], np.nan, links)
    known, beta = base.links & ~((base.K != 0) @ np.isnan(chi)), base.K @ np.nan_to_num(chi)
    beta[np.abs(beta) < ROUNDING * np.abs(beta).max()] = 0.0
    found = {name: float(x) for name, x, k in zip(base.names, beta, known, strict=True) if k}
    return found, "URDF" if "URDF" in sources else "[parameters]"


def payload_parameters(model: InverseModel, payload: Payload) -> Array:
    """The payload's XX XY XZ YY YZ ZZ MX MY MZ M (10,) in the frame of the last link,
    about its origin: a ball.

    Without a centre of mass the ball is at the origin of the payload's frame.
    Raises `BadInputError` if the mass is unknown, or the frame is no fixed link
    that the last joint carries.
    """
    if payload.mass_kg is None:
        raise BadInputError(key="payload", value=str(payload), expected="its mass")
    placement = pin.SE3.Identity()
    if payload.frame is not None:
        links = {
            frame.name: frame.placement
            for frame in model.model.frames
            if frame.parentJoint == model.robot.n and frame.type == pin.FrameType.BODY
        }
        if payload.frame not in links:
            raise BadInputError(
                place=f"robot {model.robot.name}",
                key="payload.frame",
                value=payload.frame,
                expected=f"a link that {model.robot.joints[-1].name} carries: {listed([*links])}",
            )
        placement = links[payload.frame]
    body = pin.Inertia(
        payload.mass_kg,
        np.array(payload.center_of_mass_m or (0.0, 0.0, 0.0)),
        0.4 * payload.mass_kg * BALL_RADIUS_M**2 * np.eye(3),
    )
    return np.asarray(placement.act(body).toDynamicParameters())[list(FROM_PINOCCHIO)]


def add_payload(model: InverseModel, parameters: Array, payload: Payload) -> Array:
    """Standard parameters (p,) of the robot with the payload, from those
    of the robot without it.
    """
    out = np.array(parameters, dtype=float)
    out[link_columns(model)[-1]] += payload_parameters(model, payload)
    return out


def is_a_body(parameters: Array, least: float = MIN_EIGENVALUE) -> bool:
    """Whether a body of positive density can have these ten parameters: eigenvalues of its scaled
    pseudo-inertia > `least`.
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
    """Ten parameters of link j, described, from the URDF, or of a rod to the next
    joint; and their source.
    """
    for parameters, source in ((described, "[parameters]"), (of_urdf, "URDF")):
        if is_a_body(parameters):
            return np.array(parameters), source
    ends = [*idm.joint_frames[0][np.equal(idm.parents, j + 1)], np.zeros(3)]
    along = ends[0]  # to the next joint, if there is one
    length = float(np.linalg.norm(along))
    radius = float(np.clip(SLENDERNESS * length, *RADIUS_M))
    mass = DENSITY * np.pi * radius**2 * (length + 2 * radius)
    # second moments over the mass, about the middle
    spread = np.outer(along, along) / 12 + radius**2 / 4 * np.eye(3)
    about_middle = mass * (np.trace(spread) * np.eye(3) - spread)
    rod = pin.Inertia(mass, along / 2, about_middle)
    return np.asarray(rod.toDynamicParameters())[list(FROM_PINOCCHIO)], "plausible"


def _frames_of(idm: InverseModel, prior: InverseModel) -> Array:
    """T (n, 4, 4) from the prior's link frames to the model's; it must be the
    same at all positions.
    """
    joints, others = idm.robot.joints, prior.robot.joints
    if [j.type for j in joints] != [j.type for j in others]:
        raise BadInputError(
            place=f"prior {prior.robot.name}",
            key="joints",
            value=", ".join(j.type for j in others),
            expected=", ".join(j.type for j in joints),
        )
    q = np.random.default_rng(SEED).uniform(-1.0, 1.0, size=(POSES, idm.robot.n))
    (at, turned), (at_prior, turned_prior) = idm.placements(q), prior.placements(q)
    back, T = turned.transpose(0, 1, 3, 2), np.zeros((POSES, idm.robot.n, 4, 4))
    T[..., :3, :3], T[..., 3, 3] = back @ turned_prior, 1.0
    T[..., :3, 3] = np.einsum("knij,knj->kni", back, at_prior - at)
    differs = np.abs(T - T[0]).max(axis=(0, 2, 3)) > MAX_FRAME_DIFFERENCE
    if differs.any():
        raise BadInputError(
            "its link moves differently from the fit's",
            place=f"prior {prior.robot.name}",
            key="joint",
            value=others[int(differs.argmax())].name,
            expected="the same base frame, axes, lengths and zeros",
        )
    return np.asarray(T[0])
