"""The payload of a recording as standard parameters of the last link, which carries it."""

import numpy as np
import pinocchio as pin

from acquisition.errors import listed
from acquisition.robot import Payload

from ..arrays import Array
from ..errors import BadInputError
from .inverse import FROM_PINOCCHIO, InverseModel
from .physical import link_columns

BALL_RADIUS_M = 0.1  # of the ball that a payload is taken for: its inertia about its centre of mass


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
        n, kind = model.robot.n, pin.FrameType.BODY
        links = {
            f.name: f.placement for f in model.model.frames if f.parentJoint == n and f.type == kind
        }
        if payload.frame not in links:
            place, joint = f"robot {model.robot.name}", model.robot.joints[-1].name
            raise BadInputError(
                place=place,
                key="payload.frame",
                value=payload.frame,
                expected=f"a link that {joint} carries: {listed(list(links))}",
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
