"""Simulated CiA 402 drives, the plants they move, and dry runs of a session."""

from .drives import SimulatedDrives
from .lock_step import DryRun, dry_run, serve
from .loops import SUBSTEPS, LoopGains, cascaded_loops, describe_loops
from .mechanism import Mechanism, mechanism_of
from .plants import TablePlant, middle_of_range
