"""When to believe a fit: tests of an estimate against everything that the recording tells, and one verdict."""

from .evidence import Evidence, Part, covariance_of_all
from .held_out import HeldOut, held_out_recordings
from .lines import LEVELS, Figure, Level, Trust, TrustLine, Verdict
from .physical import inertias, nearest_consistent, not_positive, pose_step, poses_of
from .replay import replay_line
from .solution import trust_in

__all__ = [
    "LEVELS",
    "Evidence",
    "Figure",
    "HeldOut",
    "Level",
    "Part",
    "Trust",
    "TrustLine",
    "Verdict",
    "covariance_of_all",
    "held_out_recordings",
    "inertias",
    "nearest_consistent",
    "not_positive",
    "pose_step",
    "poses_of",
    "replay_line",
    "trust_in",
]
