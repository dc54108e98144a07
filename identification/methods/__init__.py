"""The method: least squares and instrumental variables, from recordings to a solution.

    Model, Unknowns, Equation    recordings of a fit, their unknowns x, the terms of each recording
    Rows                         [C Z J r], linearised at x, equation (C)
    Simulated, Pass              motion of the simulated robot; estimate of one iteration
    Solution                     estimate, and the inputs of its tests

It owns the model of a fit, the iterations and the solution. `idim.solve` shows the whole method
on one screen. It may use `trust` and the subpackages below.
"""

from .idim import solve
from .iteration import Iteration, regular_start
from .model import Model, ProgressCallback, read_model
from .passes import Pass
from .solution import Solution, direct_errors, largest
from .start import least_squares, with_best_ramps
