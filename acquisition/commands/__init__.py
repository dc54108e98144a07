"""The command line: one file per command, and the parts that both packages share.

It owns options, what is printed and the exit status, and leaves the work to the
other rooms, all of which it may use.
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
