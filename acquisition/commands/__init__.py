"""The command line: parse, one call, print."""

from .command_line import STATUSES, run_command
from .program import main

__all__ = ["STATUSES", "main", "run_command"]
