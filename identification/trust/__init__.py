"""Tests of an estimate against the recording, and one verdict."""

from .candidates import Candidates
from .evidence import LEVELS, FitData, HeldOut, Trust, TrustLine
from .held_out import predictions_by_others
from .prior import with_predictions
from .solution import MIN_FIRST_STAGE_F, trust_in
