"""Simulated CiA 402 drives, the plants they move, and dry runs of a session."""

from .drives import LockStepLink, SimulatedDrives, serve
from .mechanism import (
    SUBSTEPS,
    DrivenPlant,
    LoopGains,
    TablePlant,
    cascaded_loops,
    describe_loops,
    driven_plant,
    middle_of_range,
)
