"""The recorded experiment, simulated: recordings laid out for it, the robot in closed loop, instruments along its motion."""

from .bench import Bench, DirectModelError, Place, Replica
from .experiment import EARLY_RATE_PER_BANDWIDTH, RATE_PER_BANDWIDTH, Experiment, make_experiment
from .instruments import Counting, InstrumentKind, Instruments, simulate_instruments
from .lab import Lab, PassInstruments, told, worst
from .motion import SimulatedMotion, simulated_motion
