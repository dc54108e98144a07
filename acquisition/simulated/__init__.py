"""Simulated CiA 402 drives, the plants they move, and dry runs of a session."""

from .drives import LockStepLink, SimulatedDrives, serve
from .mechanism import (
    SUBSTEPS,
    LoopGains,
    Mechanism,
    TablePlant,
    cascaded_loops,
    describe_loops,
    mechanism_of,
    middle_of_range,
)
