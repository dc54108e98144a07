"""The command line: one file per command, and shared options."""

from .program import main
