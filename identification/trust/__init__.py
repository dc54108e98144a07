"""Tests of an estimate against the recording, and one verdict.

It owns every test, its words, and the terms that a model may lack. It may use `simulation` and the
rooms below; `methods` gives it the inputs.
"""

from .candidates import Candidates
from .evidence import LEVELS, FitData, HeldOut, Trust, TrustLine
from .predictions import predictions_by_others, with_predictions
from .solution import MIN_FIRST_STAGE_F
from .verdict import trust_in
