"""Least squares in passes: friction by load depends on the estimate before, and terms that recordings cannot tell go."""

from .linearised import AtHand, Linearised, without_terms
from .links import RowStates, friction_states, links_at_rows, recorded_power, row_states, torque_of_links
from .settled import Settled, alike, leave_out_untold, load_passes, settled_least_squares
