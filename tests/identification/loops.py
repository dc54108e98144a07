"""A robot by its description, and in closed loop along a whole reference."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from acquisition.robot import Robot
from identification.control import ControlLaw, Reference, default_law
from identification.model import (
    BaseParameters,
    DirectModel,
    InverseModel,
    base_parameters,
    described_parameters,
    direct_model,
)
from identification.simulation import ClosedLoop


class Simulated(NamedTuple):
    """A simulated motion (N, n), and why it ended early, if it did."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    reason: str | None


def modelled(robot: Robot) -> tuple[InverseModel, BaseParameters, DirectModel]:
    """The models of a robot, the direct one by `[parameters]`."""
    model = InverseModel(robot)
    base = base_parameters(model)
    return (
        model,
        base,
        direct_model(model, base.standard_parameters(described_parameters(model, base))),
    )


def free(n: int, rate_hz: float) -> ControlLaw:
    """No control at all."""
    return replace(
        default_law(1.0, np.ones(n), rate_hz), Kp=np.zeros(n), Kd=np.zeros(n), gravity="none"
    )


def simulate(
    model: DirectModel,
    loop: ControlLaw,
    reference: Reference | np.ndarray,
    *,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    bound: float = 1.0,
    substeps: int = 1,
) -> Simulated:
    """As `ClosedLoop.follow`; `start` is position and speed, (n,) each, else of the reference.

    A reference of positions (N, n) only has no speed at any instant.
    """
    if isinstance(reference, np.ndarray):
        reference = Reference(reference, np.zeros_like(reference), np.zeros_like(reference))
    fastest = np.abs(reference.dq @ model.directions.T).max(axis=0, initial=0.0)
    robot = ClosedLoop(
        model, loop, start or (reference.q[0], reference.dq[0]), fastest=fastest, substeps=substeps
    )
    motion, reason = robot.follow(reference, np.full(reference.q.shape[1], bound))
    return Simulated(*motion, reason)
