"""Robots whose parameters are known: simulated recordings, the demo, Monte-Carlo studies, plants for dry runs."""

from typing import TYPE_CHECKING

from acquisition.lazy import lazy_names

from .draws import CONTROLLERS, Study
from .noise import Noise
from .study import Judged, Run, run_study, study_truth
from .summary import FALSE_ERROR, FALSE_TRUST, INSIDE, Summary, false_trust, study_json, summaries
from .synthetic import closed_loop, random_reference, write_signals

if TYPE_CHECKING:
    from .demo import Rehearsal, description, rehearse
    from .plant import described_robot

# These import what talks to drives; a fit's report, which knows of studies, has no use for it.
__getattr__, __dir__ = lazy_names(
    __name__, {"demo": ("Rehearsal", "description", "rehearse"), "plant": ("described_robot",)}
)
