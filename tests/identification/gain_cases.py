"""Robots whose drive gains are known here alone, and fits of them: their descriptions have gains
of a catalogue, or none.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from conftest import REPLAY

from acquisition.robot import Robot, robot_from_files
from identification.data import Recordings, Signals
from identification.regression import Overrides
from identification.results import Evidence, identify

Array = np.ndarray

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
CENTRE = {
    "tx40": (0.03, 0.02, 0.08),
    "emps": (0, 0, 0),
    "scara": (0.05, 0.02, 0),
    "axis": (0.3, 0.02, 0),
}


@dataclass(frozen=True, kw_only=True)
class GainCase:
    """How recordings of a robot are made.

    duration_s: of each. white: noise of the current in percent of each motor's rms. catalogue:
    the description has a catalogue's gains, else none. torques: the efforts are the motors'
    torques, only said to be in A.
    """

    robot: str
    mass_kg: float = 2.0
    duration_s: float = 4.0
    white: float = 0.0
    catalogue: bool = True
    torques: bool = False

    @property
    def gains(self) -> Array:
        """(n,) the true ones, in N m/A or N/V."""
        return np.ones_like(TRUE[self.robot]) if self.torques else TRUE[self.robot]


def with_gains(signals: Signals, gains: Array, half: Array | None) -> Signals:
    """The recording with a description that has these gains, and their half-widths (n,) if any."""
    before, unit = signals.robot, signals.robot.motors[0].recorded_unit
    torque = "N" if unit == "V" else "N m"
    robot = robot_of(
        with_motors(before.files["robot.toml"].decode(), f"{torque}/{unit}", gains, half)
    )
    return replace(
        signals, robot=robot, effort=robot.joint_effort(before.motor_effort(signals.effort))
    )


def toml_of(robot: str) -> Path:
    return (
        Path(__file__).with_name("lone_axis.toml")
        if robot == "axis"
        else REPLAY / robot / "robot.toml"
    )


def fit_with_gains(*signals: Signals) -> Evidence:
    """By the method that the package takes where none is asked for, with
    the gains of all motors.
    """
    motors = tuple(motor.name for motor in signals[0].robot.motors)
    return identify(Recordings(sources=signals), Overrides(gains=motors))


def described_robot(case: GainCase) -> Robot:
    """robot.toml with efforts in A or V, with the case's gains; without control law and drives."""
    gains = CATALOGUE[case.robot] if case.catalogue else None
    text = with_motors(toml_of(case.robot).read_text(), UNIT[case.robot], gains)
    text = re.sub(r"(?ms)^\[bus\]$.*(?=^\[parameters\]$)", "", text)
    keys = "structure|sample_rate_hz|position_gain|velocity_gain|velocity_estimate"
    return robot_of(re.sub(rf"(?m)^({keys}) = .*\n", "", text))


def with_motors(text: str, unit: str, gains: Array | None, half: Array | None = None) -> str:
    """A description with other gains, in `unit`, and their half-widths; None has efforts in
    A or V without a gain.
    """
    text = re.sub(
        r"(?m)^(effort_unit|drive_gain|drive_gain_unit|drive_gain_half_width) = .*\n", "", text
    )
    first, *motors = text.split("[[motor]]\n")
    for k, motor in enumerate(motors):
        keys = f'effort_unit = "{unit.split("/")[1]}"\n'
        if gains is not None:
            keys += f'drive_gain = {gains[k]:.17g}\ndrive_gain_unit = "{unit}"\n'
        if half is not None:
            keys += f"drive_gain_half_width = {half[k]:.17g}\n"
        first += f"[[motor]]\n{keys}{motor}"
    return first


def robot_of(text: str) -> Robot:
    return robot_from_files({"robot.toml": text.encode()}, "robot.toml")


def gains_of(fit: Evidence) -> tuple[Array, Array]:
    """The identified gains (m,) and their half-widths (m,)."""
    return np.array([one.value for one in fit.gains]), np.array([x.half_width for x in fit.gains])


def off_in_half_widths(fit: Evidence, true: Array) -> Array:
    """Distances (m,) of the identified gains from the true ones, in their half-widths."""
    return np.abs(gains_of(fit)[0] - true) / gains_of(fit)[1]
