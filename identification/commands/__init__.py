"""The command line of `robot-identify`: one file per command, and what commands share.

It owns the options, the order of reading, computing, writing and printing, and the exit statuses.
It may use every subpackage, but not the modules `notebook` and `fits`. It imports them when a
command runs, so that `--help` starts at once. No subpackage uses it.
"""

from .program import main
