"""The robot's models: inverse and direct dynamics, friction and rotors, base parameters.

It owns the names, units and columns of all parameters, and the conditions of physical consistency;
it alone imports pinocchio and coal. It may use the robot's description of `acquisition` and the
estimators, but no recordings and no fits.
"""

from .direct import (
    DirectModel,
    cholesky_solver,
    direct_model,
    direct_model_of_base,
    inertias,
    poses_of,
    regressor_gradient,
    torque_of_links,
    torque_without_sliding,
    why_not_positive,
)
from .inverse import LINK, InverseModel, link_columns
from .joint_terms import SHAPES, SLIDING, JointTerm, corner_speeds, inertia_unit
from .obstacles import Obstacles, obstacles_of
from .parameters import (
    BaseParameters,
    add_payload,
    base_parameters,
    base_prior,
    described_parameters,
    expected_links,
    is_a_body,
    known_parameters,
    load_parameters,
    payload_parameters,
)
from .physical import (
    RESISTING,
    friction_alone,
    friction_power,
    nearest_consistent,
    own_shares,
    physical_parameters,
    requirements,
    shaped_states,
)
