"""The command line of `robot-identify`: one file per command, and what commands share.

It owns the options, the order of reading, computing, writing and printing, and the exit statuses.
It may use every room but `notebook` and `fits`, and imports them when a command runs, so that
`--help` starts at once. No room uses it.
"""

from .program import main
