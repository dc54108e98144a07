"""The command line: one file per command, and the program that both packages share."""

from .command_line import STATUSES, Commands, Program, Progress, from_options, run_command
from .program import main

__all__ = ["STATUSES", "Commands", "Program", "Progress", "from_options", "main", "run_command"]
