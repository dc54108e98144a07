"""The command line: one file per command, and the parts that both packages share.

This subpackage owns the options, the printed texts and the exit status. The work is done by the
other subpackages, all of which it may use.
"""

from .command_line import (
    STATUSES,
    Program,
    Progress,
    add_flag,
    add_options,
    add_overwrite,
    add_path,
    from_options,
    run_command,
)
from .program import main
