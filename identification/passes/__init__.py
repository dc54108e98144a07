"""Least squares in passes: friction by load depends on the estimate before, and terms that a recording cannot tell go."""

from .linearised import LinearisedRecording, links_at_rows
from .settled import (
    Settled,
    alike,
    leave_out_untold,
    load_passes,
    settled_least_squares,
    told_apart,
    untold_terms,
    without,
    without_load,
)

__all__ = [
    "LinearisedRecording",
    "Settled",
    "alike",
    "leave_out_untold",
    "links_at_rows",
    "load_passes",
    "settled_least_squares",
    "told_apart",
    "untold_terms",
    "without",
    "without_load",
]
