"""The method: least squares and instrumental variables, from recordings to a solution.

    Model, Unknowns, Equation    the recordings of a fit, x of all of them, and the terms of each
    Rows                         [Z J r] about x, of equation (C)
    Simulated, Pass              Z of the simulated robot, and the estimate of one iteration
    Solution                     the estimate, and the inputs of its tests

`idim.solve` has all of it on one screen. It may use `trust` and the rooms below.
"""

from .idim import solve
from .iteration import Iteration, regular_start
from .model import Model, ProgressCallback, read_model
from .passes import Pass
from .solution import Solution, direct_errors, largest
from .start import least_squares, with_best_ramps
