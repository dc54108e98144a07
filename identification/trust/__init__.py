"""Tests of an estimate against the recording, and one verdict."""

from .fit_data import FitData, Lag, RecordingData, covariance_of_all
from .held_out import HeldOut, held_out_recordings, predictions_by_others
from .lag import combined_lag, lag_columns, lag_moves, lags_in
from .lines import LEVELS, Figure, Trust, TrustLine
from .replay import replay_line
from .solution import trust_in
