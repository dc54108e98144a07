"""Tests of an estimate against the recording, and one verdict."""

from .candidates import Candidates
from .control_law import law_line
from .fit_data import FitData, Lag, covariance_of_all, further_columns
from .held_out import held_out_parts, predictions_by_others
from .lag import by_group, combined_lag, lags_in, moves_of, simulated_rates
from .lines import LEVELS, Figure, HeldOut, Trust, TrustLine
from .prior import with_prior
from .solution import trust_in
