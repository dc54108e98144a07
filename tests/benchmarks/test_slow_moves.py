"""How well a fit of fast moves predicts slow ones, where friction has terms of slow motion.

Run with `SLOW_RUNS=6 pytest tests/benchmarks/test_slow_moves.py -s --benchmark-enable`, the
default: arms with root and load friction of the simulator that shares no code with the package,
fitted to five sines, and asked for the torque of slow moves from point to point, at 5 % of the
speed limits, with 4 % of the peak speed as the limit of slow samples and with the default.
"""

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hunt import fit_by_default
from hunt_kinds import UNIT, cell_of
from independent_robots import Plant
from independent_simulator import Imperfections, Reference, references, simulate

from identification.estimation import one_thread
from identification.regression import Overrides
from identification.results import fit_file, validate_all

RUNS = int(os.environ.get("SLOW_RUNS", "6"))
SHARE, REST_S = 0.05, 0.3  # of the speed limits; between two moves


def limits(body: Plant) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) of positions, (n,) of speeds, SI."""
    joints = body.description["joint"]
    per = [np.pi / 180 if "position_deg" in joint else 1.0 for joint in joints]
    ends = [joint.get("position_deg", joint.get("position_m")) for joint in joints]
    fastest = [joint.get("speed_deg_s", joint.get("speed_m_s")) for joint in joints]
    return np.array(ends) * np.array(per)[:, None], np.array(fastest) * per


def from_point_to_point(body: Plant, seed: int, rate_hz: float, duration_s: float) -> Reference:
    rng, (ends, fastest) = np.random.default_rng([9, seed]), limits(body)
    q, found, N = ends.mean(axis=1), [], round(duration_s * rate_hz) + 1
    inner = 0.8 * ends + 0.2 * q[:, None]
    while sum(x.shape[1] for x in found) < N:
        to = q + rng.uniform(-1, 1, body.n) * fastest * SHARE * rng.uniform(1, 2)
        to = np.clip(to, *inner.T)
        T = max(0.4, float((np.abs(to - q) * 1.875 / (fastest * SHARE)).max()))
        t = np.arange(round(T * rate_hz))[:, None] / rate_hz / T
        shape = (
            10 * t**3 - 15 * t**4 + 6 * t**5,
            (30 * t**2 - 60 * t**3 + 30 * t**4) / T,
            (60 * t - 180 * t**2 + 120 * t**3) / T**2,
        )
        move = np.stack([x * (to - q) for x in shape])
        move[0] += q
        rest = np.zeros((3, round(REST_S * rate_hz), body.n))
        rest[0], q = to, to
        found += [move, rest]
    q, dq, ddq = np.concatenate(found, axis=1)[:, None, :N]
    return Reference(q=q, dq=dq, ddq=ddq)


@one_thread
def errors(name: str, seed: int, noise: float) -> list[float]:
    """Torque errors of slow moves, without noise of their position, in percent."""
    body, law, robot = cell_of(name)
    friction, n, (_, fastest) = body.friction, body.n, limits(body)
    root = np.zeros(len(friction.coulomb))
    root[:n] = friction.coulomb[:n] / np.sqrt(fastest)
    friction = replace(friction, root=root, load=np.full(n, 0.06), smooth=0.1 * friction.smooth)
    body = replace(body, friction=friction)
    joints = tuple(
        msgspec.structs.replace(joint, friction=("viscous", "coulomb", "root", "load"))
        for joint in robot.joints
    )
    robot = replace(robot, joints=joints)
    cell = Imperfections(encoder_noise=noise * UNIT[name], torque_noise_percent=1.0)

    def recorded(path: Reference, of: Imperfections, k: int):
        return simulate(body, law, path, of, seed=k).signals(robot, 0)

    fast = references(body, range(seed, seed + 1), duration_s=10.0, rate_hz=law.rate_hz)
    slow = from_point_to_point(body, seed, law.rate_hz, 20.0)
    slow = recorded(slow, replace(cell, encoder_noise=0.0), seed + 900)
    found = []
    for percent in (4.0, None):
        fit = fit_by_default(recorded(fast, cell, seed), Overrides(low_speed_percent=percent))
        given = [(slow, Overrides(low_speed_percent=4.0))]
        _, of_all = validate_all(given, fit_file(fit), "the fit")
        found.append(of_all[-1].relative_error_percent)
    return found


@pytest.mark.parametrize("name", ["scara", "tx40"])
def test_slow_moves_are_predicted_better(name):
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for noise in (0.0, 1.0, 3.0):
            waiting = [pool.submit(errors, name, seed, noise) for seed in range(RUNS)]
            usual, slower = np.mean([one.result() for one in waiting], axis=0)
            print(f"\n{name}, noise {noise:g}: {usual:.2f} → {slower:.2f} %", flush=True)
            assert slower < 1.02 * usual
