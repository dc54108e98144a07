"""A known torque and a known feed-forward: with them the truth is inside the intervals, without them the fit says caution.

EMPS-like records of the independent simulator: pulses are added to the controller's output, and a spring acts on the axis.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from conftest import REPLAY, robot_named
from independent_robots import Array, Plant, plant
from independent_simulator import Imperfections, described_controller, references, simulate

from identification.data.signals import Signals, load_signals
from identification.errors import IdentificationError
from identification.methods import Iteration, identify_iv, identify_ls
from identification.model import InverseModel
from identification.regression import Overrides
from identification.study.synthetic import truth, write_signals

STIFFNESS, AT_REST = 900.0, 0.03  # N/m, and where the spring gives nothing, m
PULSE_V, EVERY, WIDTH = 2.0, 700, 60  # and samples


@dataclass(frozen=True, kw_only=True)
class Sprung(Plant):
    """A plant with a spring on its axis."""

    def inertia_and_bias(self, q: Array, dq: Array) -> tuple[Array, Array]:
        M, bias = super().inertia_and_bias(q, dq)
        return M, bias + STIFFNESS * (q - AT_REST)


@cache
def record(seed: int = 0) -> Signals:
    """With everything that is known of it."""
    toml = REPLAY / "emps" / "robot.toml"
    body = plant(toml, smooth=0.002)
    body = Sprung(**vars(body))
    path = references(body, range(seed, seed + 1), duration_s=10.0, rate_hz=1000.0)
    pulses = np.zeros_like(path.q)
    for k, start in enumerate(range(500, pulses.shape[1] - 500, EVERY)):
        pulses[0, start : start + WIDTH] = PULSE_V * (-1) ** (k // 2)
    cell = Imperfections(encoder_noise=1e-6, torque_noise_percent=2.0)
    runs = simulate(body, described_controller(body), path, cell, feedforward=pulses, seed=seed)
    robot = robot_named("emps")
    # The rules of the package, not what reproduces the digits of the axis's authors.
    robot = replace(robot, identification=type(robot.identification)())
    return replace(
        runs.signals(robot, 0), known_torque=-STIFFNESS * (runs.q_true[0] - AT_REST), feedforward=pulses[0]
    )


def fitted(signals: Signals, method: str):
    if method == "iv":
        return identify_iv(signals, Overrides(), Iteration())
    return identify_ls(signals, Overrides(), trust=True)


def inside(fit) -> np.ndarray:
    true = truth(InverseModel(fit.problem.signals.robot), fit.base)
    return (fit.intervals.low <= true) & (true <= fit.intervals.high)
