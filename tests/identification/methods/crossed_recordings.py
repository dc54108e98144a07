"""Two recordings of an arm with optional columns, load friction, own offsets and gains to be
found, and their fits.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
from friction_models import described
from gain_cases import CENTRE, robot_of, with_motors
from gain_cases import with_gains as described_with

from acquisition.robot import Payload, Robot
from identification.data import RecordingFile, Recordings, Signals, Work
from identification.estimation import system
from identification.regression import Overrides
from identification.results import Evidence, identify
from identification.study import Noise, closed_loop, random_reference, write_signals

RATE_HZ = 500.0
TRUE = np.array([2.0, 0.7])  # N m/A
WRONG = np.array([2.0, 0.9])  # as described where gains are identified
COLUMNS = ("velocity", "known_torque", "feedforward", "reference", "payload")
CONCERNS = ("load", "own", "gains")
CARRIED = Payload(1.0, CENTRE["scara"])
BRIEF = 1_500  # instants
KNOWN = np.array([1.0, 0.05])  # N m, known torques


@cache
def arm(concerns: frozenset[str]) -> Robot:
    """The SCARA with its efforts in A, with load friction and own offsets if asked for;
    its law is not described.
    """
    optional = {"own": "offset", "load": "load"}
    terms = [
        "viscous",
        "coulomb",
        *(term for concern, term in optional.items() if concern in concerns),
    ]
    more = ("mu1 = 0.3\nmu2 = 0.3\n" if "load" in concerns else "") + (
        "Off1 = 0.3\n" if "own" in concerns else ""
    )
    text = described("scara", [terms, terms], more).files["robot.toml"].decode()
    law = ("structure", "sample_rate_hz", "position_gain", "velocity_gain", "velocity_estimate")
    text = "\n".join(line for line in text.splitlines() if not line.startswith(law))
    text = text[: text.index("[bus]")] + text[text.index("[parameters]") :]
    own = '[identification]\nown = ["Off"]\n' if "own" in concerns else ""
    return robot_of(with_motors(f"{text}\n{own}", "N m/A", TRUE))


@cache
def simulated(
    concerns: frozenset[str], seed: int, payload: Payload | None, duration_s: float = 4.0
) -> Signals:
    robot = arm(concerns)
    q = random_reference(robot, duration_s=duration_s, sample_rate_hz=RATE_HZ, seed=seed)
    return closed_loop(
        robot,
        q,
        RATE_HZ,
        noise=Noise(encoder_step=1e-6, effort_percent=2.0),
        seed=seed,
        payload=payload,
    )


def recorded(
    concerns: frozenset[str], columns: frozenset[str], seed: int, duration_s: float = 4.0
) -> Signals:
    """A recording with these columns; the second one carries the payload."""
    signals = simulated(
        concerns, seed, CARRIED if "payload" in columns and seed == 2 else None, duration_s
    )
    t_s = signals.t_s[:, None]
    given = {}
    if "velocity" in columns:
        given["velocity"] = np.gradient(signals.q, signals.t_s, axis=0)
    if "known_torque" in columns:  # a part of what the robot needs is from elsewhere
        given["known_torque"] = KNOWN * np.sin(7 * t_s)
        given["effort"] = signals.effort - given["known_torque"]
    if "feedforward" in columns:
        given["feedforward"] = 0.02 * KNOWN * np.sin(5 * t_s)
    reference = signals.q_ref if "reference" in columns else None
    signals = replace(signals, q_ref=reference, recording=f"r{seed}.mcap", **given)
    return described_with(signals, WRONG, None) if "gains" in concerns else signals


def written(
    folder: Path,
    concerns: frozenset[str],
    columns: frozenset[str],
    duration_s: float = 4.0,
    count: int = 2,
) -> list[Path]:
    paths = [folder / f"r{seed}.mcap" for seed in range(1, count + 1)]
    for seed, path in enumerate(paths, 1):
        write_signals(path, recorded(concerns, columns, seed, duration_s), source="test")
    return paths


def fitted(paths: list[Path], concerns: frozenset[str], work: Work, **settings: float) -> Evidence:
    overrides = Overrides(gains=("motor_2",) if "gains" in concerns else None, **settings)
    return identify(Recordings(sources=tuple(map(RecordingFile.at, paths)), work=work), overrides)


def as_long(function, *of, **settings):
    """The task `function`, to which a recording of four seconds is long; in a worker too."""
    with patch.multiple(system, SHORT=BRIEF, SPANS=24):
        return function(*of, **settings)


def bits(fit: Evidence) -> list[bytes]:
    arrays = fit.estimate.beta, fit.intervals.covariance, fit.tau_predicted
    return [x.tobytes() for x in arrays] + [repr(fit.trust.lines).encode()]
