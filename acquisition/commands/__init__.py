"""The command line: one file per command, and the program that both packages share."""

from typing import TYPE_CHECKING

from ..lazy import lazy_names
from .command_line import STATUSES, Commands, Program, Progress, add_overwrite, from_options, run_command

if TYPE_CHECKING:
    from .program import main

# `robot-identify` shares the program, not the commands, which import everything that talks to drives.
__getattr__, __dir__ = lazy_names(__name__, {"program": ("main",)})
