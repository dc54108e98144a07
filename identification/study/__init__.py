"""Robots whose parameters are known: simulated recordings, the demo, Monte-Carlo studies, plants for dry runs."""

from .demo import Rehearsal, description, rehearse
from .noise import Noise
from .plant import described_robot
from .study import FALSE_ERROR, Run, Study, run_study, study_json, study_truth, summaries
from .synthetic import closed_loop, random_reference, write_signals

__all__ = [
    "FALSE_ERROR",
    "Noise",
    "Rehearsal",
    "Run",
    "Study",
    "closed_loop",
    "described_robot",
    "description",
    "random_reference",
    "rehearse",
    "run_study",
    "study_json",
    "study_truth",
    "summaries",
    "write_signals",
]
