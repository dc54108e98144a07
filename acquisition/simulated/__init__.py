"""Simulated CiA 402 drives, the plants that they move, and dry runs of a session.

This subpackage owns everything that replaces hardware, but no rules of a session. It may use `bus`,
`recording`, `robot` and `protocol`.
"""

from .drives import LockStepLink, SimulatedDrives, serve
from .mechanism import (
    SUBSTEPS,
    DrivenPlant,
    JointwisePlant,
    LoopGains,
    Plant,
    TablePlant,
    cascaded_loops,
    describe_loops,
    driven_plant,
    middle_of_range,
    rated_motor_effort,
    typical_inertia,
    typical_plant,
)
from .node import SimulatedNode
