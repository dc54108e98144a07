"""Tests of an estimate against the recording, and one verdict."""

from .fit_data import FitData, Lag, RecordingData, covariance_of_all
from .held_out import held_out_parts, predictions_by_others
from .lag import combined_lag, lag_columns, lag_moves, lags_in
from .lines import LEVELS, Figure, HeldOut, Trust, TrustLine
from .replay import replay_line
from .solution import trust_in
