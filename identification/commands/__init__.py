"""The command line: options and their values."""

from .program import main

__all__ = ["main"]
