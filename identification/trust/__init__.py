"""Tests of an estimate against the recording, and one verdict."""

from .candidates import Candidates
from .fit_data import FitData, relative_residual
from .held_out import predictions_by_others
from .lag import moves_of
from .lines import LEVELS, Figure, HeldOut, Trust, TrustLine
from .prior import with_predictions
from .solution import MIN_FIRST_STAGE_F, trust_in
