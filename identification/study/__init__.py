"""Robots whose parameters are known: simulated recordings, the demo, Monte-Carlo studies, plants for dry runs."""

from .demo import Rehearsal, description, rehearse
from .draws import CONTROLLERS, Study
from .noise import Noise
from .plant import described_robot
from .study import Judged, Run, run_study, study_truth
from .summary import FALSE_ERROR, FALSE_TRUST, INSIDE, Summary, false_trust, study_json, summaries
from .synthetic import closed_loop, random_reference, write_signals

__all__ = [
    "CONTROLLERS",
    "FALSE_ERROR",
    "FALSE_TRUST",
    "INSIDE",
    "Judged",
    "Noise",
    "Rehearsal",
    "Run",
    "Study",
    "Summary",
    "closed_loop",
    "described_robot",
    "description",
    "false_trust",
    "random_reference",
    "rehearse",
    "run_study",
    "study_json",
    "study_truth",
    "summaries",
    "write_signals",
]
