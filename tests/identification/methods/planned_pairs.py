"""Pairs of recordings with and without a payload, by the model of the fit along a planned
motion: nothing is simulated.

Made in a tenth of a second. Their gains are those of `gain_cases`; the position is exact, the
current may have white noise.
"""

from dataclasses import replace

import numpy as np
from conftest import described_chi
from gain_cases import CENTRE, GainCase, described_robot

from acquisition.robot import Payload, Robot
from identification.data import Signals, signals_from_arrays
from identification.model import InverseModel, add_payload

RATE_HZ = 1000.0
SLOWEST_HZ, FASTEST_HZ = 0.2, 1.5  # of the motion


def planned_motion(
    robot: Robot, seed: int, duration_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, dq, ddq (N, n): five sines for each joint, with its derivatives."""
    rng, n = np.random.default_rng([7, seed]), robot.n
    w = 2 * np.pi * rng.uniform(SLOWEST_HZ, FASTEST_HZ, (5, n))
    phase, share = rng.uniform(0, 2 * np.pi, (5, n)), rng.uniform(0.5, 1.0, (5, n))
    size = np.array([0.02 if joint.type == "prismatic" else 0.2 for joint in robot.joints]) * share
    at = np.arange(round(duration_s * RATE_HZ))[:, None, None] / RATE_HZ * w + phase
    return tuple((size * x).sum(axis=1) for x in (np.sin(at), w * np.cos(at), -(w**2) * np.sin(at)))


def planned(case: GainCase, payload: Payload | None, seed: int, *, push: float = 0.0) -> Signals:
    """A recording of the case's robot that carries the payload, stated as it is; `push` is the
    amplitude of known torques.
    """
    robot = described_robot(case)
    model, rng = InverseModel(robot), np.random.default_rng([8, seed, payload is None])
    q, dq, ddq = planned_motion(robot, seed, case.duration_s)
    chi = described_chi(model)
    torque = model.regressor(q, dq, ddq) @ (
        chi if payload is None else add_payload(model, chi, payload)
    )
    known = push * np.sin(np.arange(1, robot.n + 1) * 9 * np.arange(len(q))[:, None] / RATE_HZ)
    current = np.linalg.solve(robot.R.T, (torque - known).T).T / case.gains
    current += (
        0.01
        * case.white
        * np.sqrt(np.mean(current**2, axis=0))
        * rng.standard_normal(current.shape)
    )
    name = f"{'free' if payload is None else 'loaded'}_{seed}.mcap"
    found = signals_from_arrays(
        q, robot.joint_effort(current), RATE_HZ, robot, known_torque=known if push else None
    )
    return replace(found, recording=name, payload=payload, effort_timing="measured")


def planned_pair(case: GainCase, seed: int = 0) -> tuple[Signals, Signals]:
    """Without and with the case's payload, mass and centre of mass stated, along two motions."""
    payload = Payload(case.mass_kg, tuple(map(float, CENTRE[case.robot])))
    return planned(case, None, 2 * seed), planned(case, payload, 2 * seed + 1)
