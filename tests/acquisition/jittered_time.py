"""The SCARA of the independent simulator logged every 8 to 13 ms, 5 % of the stamps off by 1 ms,
and its import and fit.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from conftest import REPLAY
from described_truth import off
from independent_robots import plant
from independent_simulator import Imperfections, Runs, described_controller, references, simulate

from acquisition.importing import import_tables
from acquisition.robot import load_robot
from identification.data import load_signals
from identification.regression import Overrides
from identification.results import identify_ls

STEPS_MS, SHARES = (8, 9, 10, 11, 12, 13), (0.1, 0.2, 0.4, 0.15, 0.1, 0.05)
OFF, TICK_S = 0.05, 0.001
RATE_HZ, CHUNK = 100.0, 20
MAP = """
[time]
column = "t"
resample_hz = 100
[position]
columns = ["q1", "q2"]
unit = "rad"
side = "joint"
[reference]
columns = ["r1", "r2"]
unit = "rad"
side = "joint"
[effort]
columns = ["e1", "e2"]
unit = "N m"
side = "joint"
"""


@dataclass(frozen=True, kw_only=True)
class Jittered:
    """Of each run and parameter (S, b), whether the interval has the truth."""

    inside: np.ndarray


def drawn(seed: int, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Times of rows in whole ms, and the stamps written beside them."""
    rng = np.random.default_rng([7, seed])
    times_ms = np.cumsum(
        rng.choice(STEPS_MS, size=int(1e3 * duration_s / min(STEPS_MS)) + 1, p=SHARES)
    )
    times_ms = times_ms[times_ms < 1e3 * duration_s]
    stamps = times_ms * 1e-3
    off = rng.random(len(stamps)) < OFF
    stamps[off] += rng.choice([-TICK_S, TICK_S], off.sum())
    return times_ms, stamps


def write_table(folder: Path, runs: Runs, run: int, seed: int) -> Path:
    times_ms, stamps = drawn(seed, runs.q.shape[1] / runs.rate_hz)
    rows = np.rint(times_ms * 1e-3 * runs.rate_hz).astype(int)
    columns = [stamps[:, None], runs.q[run][rows], runs.q_ref[run][rows], runs.effort[run][rows]]
    path = folder / "log.csv"
    np.savetxt(
        path,
        np.hstack(columns),
        delimiter=",",
        header="t,q1,q2,r1,r2,e1,e2",
        comments="",
        fmt="%.12g",
    )
    return path


def covered(folder: Path, runs: int, duration_s: float = 10.0) -> Jittered:
    body, robot, inside = (
        plant(REPLAY / "scara" / "robot.toml"),
        load_robot(REPLAY / "scara" / "robot.toml"),
        [],
    )
    robot = replace(robot, identification=type(robot.identification)())  # the package's own rules
    controller, cell = (
        described_controller(body),
        Imperfections(encoder_noise=1e-5, torque_noise_percent=2.0),
    )
    (folder / "map.toml").write_text(MAP)
    for first in range(0, runs, CHUNK):
        seeds = range(first, min(runs, first + CHUNK))
        path = references(body, seeds, duration_s=duration_s, rate_hz=controller.rate_hz)
        found = simulate(body, controller, path, cell, seed=first)
        for run, seed in enumerate(seeds):
            table = write_table(folder, found, run, seed)
            log = import_tables([table], robot, folder / "map.toml", folder / "log.mcap").out
            fit = identify_ls(load_signals(log, robot), Overrides())
            inside.append(off(fit, robot) <= 1)
    return Jittered(inside=np.array(inside))
