"""The robot's description: joints, motors, limits, the bus and its drives, resolved."""

from .bus import BusFile, DriveFile, parse_homed
from .drives import LARGEST_LOAD, Bus, Drive, refuse_load, refuse_out_of_range, resolve
from .extra_objects import extra_columns
from .limits import held_against_limits
from .robot import DH, Controller, Edges, Joint, LowSpeed, Robot, load_robot, low_speed_by_method, robot_from_files
from .toml import Positive, parse_toml

__all__ = [
    "DH",
    "LARGEST_LOAD",
    "Bus",
    "BusFile",
    "Controller",
    "Drive",
    "DriveFile",
    "Edges",
    "Joint",
    "LowSpeed",
    "Positive",
    "Robot",
    "extra_columns",
    "held_against_limits",
    "load_robot",
    "low_speed_by_method",
    "parse_homed",
    "parse_toml",
    "refuse_load",
    "refuse_out_of_range",
    "resolve",
    "robot_from_files",
]
