"""Tests of an estimate against the recording, and one verdict."""

from .candidates import Candidates
from .fit_data import FitData
from .held_out import predictions_by_others
from .lines import LEVELS, HeldOut, Trust, TrustLine
from .prior import with_predictions
from .solution import MIN_FIRST_STAGE_F, trust_in
