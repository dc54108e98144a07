"""Tests of an estimate against the recording, and one verdict.

It owns every test, its words, and the terms that a model may lack. It may use `simulation` and the
rooms below; `methods` gives it the inputs.
"""

from .candidates import Candidates
from .drives import control_law_line
from .evidence import LEVELS, WORDS, FitData, HeldOut, Trust, judge, part_of
from .predictions import predictions_by_others, with_predictions
from .solution import MIN_FIRST_STAGE_F, fixed_point_line
from .verdict import trust_in
