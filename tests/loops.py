"""A robot in closed loop along a whole reference."""

from typing import NamedTuple

import numpy as np

from identification.model import DirectModel
from identification.simulation import ClosedLoop, ControlLaw, Reference


class Simulated(NamedTuple):
    """A simulated motion (N, n), and why it ended early, if it did."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    reason: str | None


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
    robot = ClosedLoop(model, loop, start, fastest=fastest, substeps=substeps)
    motion, reason = robot.follow(reference, bound)
    return Simulated(*motion, reason)
