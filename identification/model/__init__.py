"""The robot's models: inverse and direct dynamics, friction and rotors, base parameters. Only this room imports pinocchio."""

from .base import BaseParameters, base_parameters
from .derivatives import regressor_gradient, smooth_torque
from .direct import DirectModel, direct_model
from .inverse import LINK, InverseModel
from .joint_terms import JointTerm
from .obstacles import Obstacles, obstacles_of
from .physical import RESISTING, ExpectedLinks, expected_links, is_a_body, link_columns, physical_parameters

__all__ = [
    "LINK",
    "RESISTING",
    "BaseParameters",
    "DirectModel",
    "ExpectedLinks",
    "InverseModel",
    "JointTerm",
    "Obstacles",
    "base_parameters",
    "direct_model",
    "expected_links",
    "is_a_body",
    "link_columns",
    "obstacles_of",
    "physical_parameters",
    "regressor_gradient",
    "smooth_torque",
]
