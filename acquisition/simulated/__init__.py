"""Simulated CiA 402 drives, the plants they move, and dry runs of a session."""

from .drives import SimulatedDrives
from .lock_step import DryRun, dry_run, serve
from .loops import SUBSTEPS, LoopGains, cascaded_loops, describe_loops
from .mechanism import Mechanism, mechanism_of
from .plants import TablePlant, middle_of_range

__all__ = [
    "SUBSTEPS",
    "DryRun",
    "LoopGains",
    "Mechanism",
    "SimulatedDrives",
    "TablePlant",
    "cascaded_loops",
    "describe_loops",
    "dry_run",
    "mechanism_of",
    "middle_of_range",
    "serve",
]
