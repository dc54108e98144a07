"""Pairs of recordings in A or V, one of them with a weighed payload, whose drive gains are known here alone.

The current is the motor's torque over its true gain, with noise of its own. The description has gains of a catalogue, or none.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from conftest import REPLAY
from independent_robots import level_axis, plant
from independent_simulator import Imperfections, Runs, described_controller, references, simulate

from acquisition.robot import Payload, Robot, robot_from_files
from identification.data import Recordings, Signals
from identification.methods import Fit, identify
from identification.regression import Overrides

Array = np.ndarray
RobotName = Literal["tx40", "emps", "scara", "axis"]

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


@dataclass(frozen=True, kw_only=True)
class GainCase:
    """How pairs of a robot are made.

    duration_s: of each recording. white: noise of the current in percent of each motor's rms. catalogue: the description has a
    catalogue's gains, else none. law: it has the control law, in the unit of the current. torques: the efforts are the motors'
    torques, only said to be in A.
    """

    robot: RobotName = "tx40"
    what: str = ""
    mass_kg: float = 2.0
    duration_s: float = 10.0
    white: float = 0.0
    catalogue: bool = True
    law: bool = False
    torques: bool = False

    @property
    def gains(self) -> Array:
        """(n,) the true ones, in N m/A or N/V."""
        return np.ones_like(TRUE[self.robot]) if self.torques else TRUE[self.robot]


class Pair(NamedTuple):
    """Two recordings along one reference; the second is with the payload."""

    free: Signals
    loaded: Signals


def pair_of(case: GainCase, seed: int) -> Pair:
    """Of the EMPS, simulated: under one controller and along the same reference, the mass alone stated."""
    free = plant(toml_of(case.robot))
    controller, robot = described_controller(free), described_robot(case)
    path = references(free, range(seed, seed + 1), duration_s=case.duration_s, rate_hz=controller.rate_hz)
    loaded = replace(free, rigid=level_axis(free.description["parameters"]["M1"] + case.mass_kg))
    made = (simulate(body, controller, path, Imperfections(recorded="mean"), seed=seed) for body in (free, loaded))
    one, other = (in_recorded_unit(case, runs, robot, name) for runs, name in zip(made, "ab", strict=True))
    return Pair(one, with_stated(other, case.mass_kg))


def in_recorded_unit(case: GainCase, runs: Runs, robot: Robot, name: str) -> Signals:
    current = np.linalg.solve(robot.R.T, runs.effort[0].T).T / case.gains
    signals = replace(runs.signals(robot, 0), effort=robot.joint_effort(current))
    return replace(signals, recording=f"{name}.mcap", sha256=name * 64)


def with_stated(signals: Signals, mass_kg: float | None, centre: Sequence[float] | None = None) -> Signals:
    """The recording with this payload stated; its mass is None where it is to be found."""
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


def fit_with_gains(*signals: Signals) -> Fit:
    """By the method that the package takes where none is asked for, with the gains of all motors."""
    motors = tuple(motor.name for motor in signals[0].robot.motors)
    return identify(Recordings(sources=signals), Overrides(gains=motors))


def described_robot(case: GainCase) -> Robot:
    """robot.toml with efforts in A or V, with the case's gains and perhaps its control law; without drives."""
    text = with_motors(
        toml_of(case.robot).read_text(), UNIT[case.robot], CATALOGUE[case.robot] if case.catalogue else None
    )
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
    """The keys of a cascade, in the unit of the current: its gain of the speed carries it."""
    c = described_controller(plant(toml_of(case.robot)))
    velocity = c.velocity_gain * c.drive_gain / case.gains
    return (
        f'structure = "{c.structure}"\nsample_rate_hz = {c.rate_hz}\nvelocity_estimate = "two_sample_mean"\n'
        f"position_gain = {c.position_gain.tolist()}\nvelocity_gain = {velocity.tolist()}\n"
    )


def robot_of(text: str) -> Robot:
    return robot_from_files({"robot.toml": text.encode()}, "robot.toml")
