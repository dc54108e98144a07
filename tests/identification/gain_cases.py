"""Pairs of recordings in A or V, one of them with a weighed payload, whose drive gains are known here alone.

The simulator gives torques. The current is the motor's torque over its true gain, with noise of its own: a simulation is used
for every noise of the current. The description has gains of a catalogue, or none.
"""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from conftest import REPLAY
from independent_robots import Plant, level_axis, plant, with_payload
from independent_simulator import (
    Controller,
    Imperfections,
    Runs,
    coloured,
    described_controller,
    designed_pd,
    references,
    shifted,
    simulate,
)

from acquisition.robot import Robot, robot_from_files
from identification.data import Recordings, Signals
from identification.estimation import one_thread
from identification.methods import Fit, identify
from identification.regression import Overrides

Array = np.ndarray
RobotName = Literal["tx40", "emps", "scara", "axis"]
QUIET = Imperfections(recorded="mean")
TEN_COUNTS = replace(QUIET, encoder_noise=1e-4, encoder_step=1e-5)  # rad, and the controller acts on it

# Torque per A or V of each motor, true and as a catalogue has it; N m/A, and N/V of the EMPS.
TRUE = {
    "tx40": np.array([0.400, 0.282, 0.560, 0.231, 0.345, 0.256]),
    "emps": np.array([35.15]),
    "scara": np.array([2.10, 0.66]),
    "axis": np.array([1.2]),
}
CATALOGUE = {
    "tx40": np.array([0.32, 0.32, 0.40, 0.33, 0.30, 0.32]),  # true: +25, -12, +40, -30, +15, -20 %
    "emps": np.array([30.0]),
    "scara": np.array([1.75, 0.80]),
    "axis": np.array([1.0]),
}
UNIT = {"tx40": "N m/A", "emps": "N/V", "scara": "N m/A", "axis": "N m/A"}
# Centre of mass in m, in the last link's frame.
CENTRE = {"tx40": (0.03, 0.02, 0.08), "emps": (0, 0, 0), "scara": (0.05, 0.02, 0), "axis": (0.3, 0.02, 0)}
SIDES = np.array([0.10, 0.14, 0.06])  # m, of the box that a payload is


@dataclass(frozen=True, kw_only=True)
class GainCase:
    """How pairs of a robot are made.

    duration_s: of each recording. loop: what the controller and the robot feel. white, coloured: noise of the current in
    percent of each motor's rms, white and AR(0.98). lag: samples by which the current is late, which nobody states.
    centre_known: the centre of mass is stated with the mass. catalogue: the description has a catalogue's gains, else none.
    law: it has the control law, in the unit of the current. torques: the efforts are the motors' torques, only said to be in A.
    """

    robot: RobotName = "tx40"
    what: str
    mass_kg: float = 2.0
    duration_s: float = 10.0
    loop: Imperfections = QUIET
    white: float = 0.0
    coloured: float = 0.0
    lag: float = 0.0
    centre_known: bool = False
    catalogue: bool = True
    law: bool = False
    torques: bool = False

    @property
    def most_bias(self) -> float:
        """How far the mean of many pairs may be from the truth, in percent."""
        return 4.0 if self.coloured else 1.0 if self.white else 0.5

    @property
    def name(self) -> str:
        return f"{self.robot.upper()}, {self.mass_kg:g} kg, {self.what}"

    @property
    def gains(self) -> Array:
        """(n,) the true ones, in N m/A or N/V."""
        return np.ones_like(TRUE[self.robot]) if self.torques else TRUE[self.robot]

    @property
    def described(self) -> Array:
        """(n,) those by which the description gives torques; ones where it has none."""
        return CATALOGUE[self.robot] if self.catalogue else np.ones_like(self.gains)

    @property
    def payload(self) -> Array:
        """(10,) XX XY XZ YY YZ ZZ MX MY MZ M of the payload in the last link's frame."""
        c, m = np.array(CENTRE[self.robot]), self.mass_kg
        tensor = m * (c @ c * np.eye(3) - np.outer(c, c)) + self.about_centre
        return np.concatenate([tensor[np.triu_indices(3)], m * c, [m]])

    @property
    def about_centre(self) -> Array:
        """(3, 3) inertia of the payload about its centre of mass."""
        return self.mass_kg / 12 * np.diag((SIDES**2).sum() - SIDES**2)


TRIED_WITH = GainCase(what="5 % white", white=5.0)
CASES = (
    GainCase(what="no noise"),
    TRIED_WITH,
    GainCase(what="5 % white, centre of mass known", white=5.0, centre_known=True),
    GainCase(what="5 % white, no catalogue", white=5.0, catalogue=False),
    GainCase(what="5 % white, control law described", white=5.0, law=True),
    GainCase(what="5 % AR(0.98)", coloured=5.0),
    GainCase(what="5 % white", white=5.0, mass_kg=0.5),
    GainCase(what="5 % white, lag of a sample", white=5.0, lag=1.0),
    GainCase(what="5 % white, ten counts in the loop", white=5.0, loop=TEN_COUNTS),
    GainCase(robot="emps", what="5 % white", white=5.0, mass_kg=20.0, law=True),
    GainCase(robot="scara", what="5 % white", white=5.0, law=True),
)
WEIGHED = GainCase(what="another payload on another day", mass_kg=1.4, white=5.0)
OTHER_DAY = 1000  # seeds from here on are of other references


class Pair(NamedTuple):
    """Two recordings along one reference, the true gains (n,), and the true payload (10,) of the second."""

    free: Signals
    loaded: Signals
    gains: Array
    payload: Array


def pairs_of(case: GainCase, seeds: range) -> list[Pair]:
    """A pair for each seed, all of them simulated side by side: 1.4 s each of 40, 20 s one alone."""
    simulated = _simulated(case.robot, case.mass_kg, case.duration_s, case.loop, seeds)
    robot = described_robot(case)
    found = []
    for k, seed in enumerate(seeds):
        free, loaded = (
            _in_recorded_unit(case, runs, k, robot, np.random.default_rng([4, seed, which]))
            for which, runs in enumerate(simulated)
        )
        centre = CENTRE[case.robot] if case.centre_known else None
        found.append(Pair(free, with_stated(loaded, case.mass_kg, centre), case.gains, case.payload))
    return found


def pair_of(case: GainCase, seed: int) -> Pair:
    """The pair of a seed alone."""
    return pairs_of(case, range(seed, seed + 1))[0]


def with_stated(signals: Signals, mass_kg: float | None, centre: Sequence[float] | None = None) -> Signals:
    """The recording with this payload stated; its mass is None where it is to be found."""
    from acquisition.robot import Payload

    stated = Payload(mass_kg=mass_kg, center_of_mass_m=None if centre is None else tuple(centre))
    return replace(signals, payload=stated)


def with_gains(signals: Signals, gains: Array, half: Array | None) -> Signals:
    """The recording with a description that has these gains, and their half-widths (n,) if any."""
    before, unit = signals.robot, signals.robot.motors[0].recorded_unit
    torque = "N" if unit == "V" else "N m"
    robot = robot_of(with_motors(before.files["robot.toml"].decode(), f"{torque}/{unit}", gains, half))
    return replace(signals, robot=robot, effort=robot.joint_effort(before.motor_effort(signals.effort)))


def toml_of(robot: RobotName) -> Path:
    return Path(__file__).with_name("lone_axis.toml") if robot == "axis" else REPLAY / robot / "robot.toml"


class Fitted(NamedTuple):
    """Gains of a pair as identified (n,): values and half-widths in N m/A or N/V, and whether each is determined."""

    values: Array
    half: Array
    determined: Array


@one_thread
def fitted_gains(cases: Sequence[GainCase], seeds: range) -> list[list[Fitted]]:
    """By case the gains of each pair; the cases have one simulation in common."""
    found = []
    for case in cases:
        fits = [fit_with_gains(pair.free, pair.loaded).gains for pair in pairs_of(case, seeds)]
        found.append([Fitted(gains.values, gains.half, gains.determined) for gains in fits])
    return found


def fit_with_gains(*signals: Signals) -> Fit:
    """By the method that the package takes where none is asked for, with the gains of all motors."""
    motors = tuple(motor.name for motor in signals[0].robot.motors)
    return identify(Recordings(sources=signals), Overrides(gains=motors))


@one_thread
def weighed_masses(seeds: range) -> list[tuple[float, float]]:
    """Mass and half-width in kg of the payload of `WEIGHED`, by the gains of one pair and their half-widths."""
    found = []
    others = pairs_of(WEIGHED, range(OTHER_DAY + seeds.start, OTHER_DAY + seeds.stop))
    for pair, other in zip(pairs_of(TRIED_WITH, seeds), others, strict=True):
        gains = fit_with_gains(pair.free, pair.loaded).gains
        what = with_stated(other.loaded, None)
        fit = identify(
            Recordings(sources=tuple(with_gains(one, gains.values, gains.half) for one in (other.free, what))),
            Overrides(),
        )
        (payload,) = fit.payloads
        found.append((float(payload.values[-1]), float(payload.half[-1])))
    return found


def controller_of(robot: RobotName, body: Plant) -> Controller:
    """The described controller, or for the arm, which describes none, a PD."""
    return designed_pd(body, bandwidth_hz=10.0, rate_hz=1000.0) if robot == "tx40" else described_controller(body)


@lru_cache(maxsize=6)
def _simulated(
    robot: RobotName, mass_kg: float, duration_s: float, loop: Imperfections, seeds: range
) -> tuple[Runs, Runs]:
    """Without and with the payload, under one controller and along the same references; their efforts are torques."""
    toml, case = toml_of(robot), GainCase(robot=robot, what="", mass_kg=mass_kg)
    free = plant(toml)
    controller = controller_of(robot, free)
    reference = references(free, seeds, duration_s=duration_s, rate_hz=controller.rate_hz)
    if robot == "emps":
        loaded = replace(free, rigid=level_axis(free.description["parameters"]["M1"] + mass_kg))
    else:
        loaded = with_payload(plant(toml, closed_form=False), mass_kg, CENTRE[robot], case.about_centre)
    first = seeds.start
    return tuple(
        simulate(body, controller, reference, loop, seed=2 * first + which) for which, body in enumerate((free, loaded))
    )


def _in_recorded_unit(case: GainCase, runs: Runs, run: int, robot: Robot, rng: np.random.Generator) -> Signals:
    torque = shifted(runs.effort[run : run + 1], case.lag)
    current = np.linalg.solve(robot.R.T, torque[0].T).T / case.gains
    level = np.sqrt(np.mean(current**2, axis=0)) / 100
    current = current + case.white * level * rng.standard_normal(current.shape)
    current += case.coloured * level * coloured(rng, (1, *current.shape))[0]
    signals = runs.signals(robot, run, "unknown" if case.lag else None)
    return _named(replace(signals, effort=robot.joint_effort(current)))


def _named(signals: Signals) -> Signals:
    digest = hashlib.sha256(signals.q.tobytes() + signals.effort.tobytes()).hexdigest()
    return replace(signals, recording=f"{digest[:8]}.mcap", sha256=digest)


def described_robot(case: GainCase) -> Robot:
    """robot.toml with efforts in A or V, with the case's gains and perhaps its control law; without drives."""
    text = with_motors(toml_of(case.robot).read_text(), UNIT[case.robot], case.described if case.catalogue else None)
    text = re.sub(r"(?ms)^\[bus\]$.*(?=^\[parameters\]$)", "", text)
    keys = "structure|sample_rate_hz|position_gain|velocity_gain|velocity_estimate"
    text = re.sub(rf"(?m)^({keys}) = .*\n", "", text)
    law = law_of(case) if case.law else ""
    return robot_of(text.replace("[controller]\n", f"[controller]\n{law}"))


def with_motors(text: str, unit: str, gains: Array | None, half: Array | None = None) -> str:
    """A description with other gains, in `unit`, and their half-widths; None has efforts in A or V without a gain."""
    text = re.sub(r"(?m)^(effort_unit|drive_gain|drive_gain_unit|drive_gain_half_width) = .*\n", "", text)
    first, *motors = text.split("[[motor]]\n")
    for k, motor in enumerate(motors):
        keys = f'effort_unit = "{unit.split("/")[1]}"\n'
        if gains is not None:
            keys += f'drive_gain = {gains[k]:.17g}\ndrive_gain_unit = "{unit}"\n'
        if half is not None:
            keys += f"drive_gain_half_width = {half[k]:.17g}\n"
        first += f"[[motor]]\n{keys}{motor}"
    return first


def law_of(case: GainCase) -> str:
    """The keys of the control law, in the unit of the current: its proportional and its speed's gain carry it."""
    c = controller_of(case.robot, plant(toml_of(case.robot)))
    per_unit = c.drive_gain / case.gains
    position = c.position_gain * (1.0 if c.structure.startswith("cascade") else per_unit)
    mean = "two_sample_mean" if c.two_sample_mean else "backward_difference"
    return (
        f'structure = "{c.structure}"\nsample_rate_hz = {c.rate_hz}\nvelocity_estimate = "{mean}"\n'
        f"position_gain = {position.tolist()}\nvelocity_gain = {(c.velocity_gain * per_unit).tolist()}\n"
    )


def robot_of(text: str) -> Robot:
    return robot_from_files({"robot.toml": text.encode()}, "robot.toml")
