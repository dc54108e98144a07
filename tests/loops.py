"""A robot in closed loop along a whole reference."""

import numpy as np

from identification.model import DirectModel
from identification.simulation import ClosedLoop, ControlLaw, Reference
from identification.simulation.closed_loop import Simulated


def simulate(
    model: DirectModel,
    loop: ControlLaw,
    reference: Reference,
    *,
    start: tuple[np.ndarray, np.ndarray],
    bound: np.ndarray,
    substeps: int = 1,
) -> Simulated:
    """As `ClosedLoop.follow`; `start` is position and speed, (n,) each."""
    fastest = np.abs(reference.dq @ model.directions.T).max(axis=0, initial=0.0)
    robot = ClosedLoop(model, loop, start, fastest=fastest, substeps=substeps, cell=reference.disturbances)
    return robot.follow(reference, bound)
