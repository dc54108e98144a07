"""Tests of an estimate against the recording, and one verdict.

It owns every test, its words, and the terms that a model may lack. It may use `simulation` and the
subpackages below; `methods` gives it the inputs.
"""

from .candidates import Candidates
from .drives import control_law_line
from .efforts import DEGREES, Undone, undo
from .evidence import LEVELS, TrustInputs
from .predictions import HeldOut, predictions_by_others, with_predictions
from .solution import FIXED_POINT, MIN_FIRST_STAGE_F, POSITION_NOISE, fixed_point_line
from .verdict import WORDS, Trust, trust_in
