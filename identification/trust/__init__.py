"""Tests of an estimate against the recording, and one verdict."""

from .candidates import Candidates
from .fit_data import FitData, relative_residual
from .held_out import held_out_parts, predictions_by_others
from .lag import moves_of
from .lines import LEVELS, Figure, HeldOut, Trust, TrustLine
from .prior import with_prior
from .solution import MIN_FIRST_STAGE_F, trust_in
