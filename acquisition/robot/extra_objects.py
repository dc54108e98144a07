"""Further objects of drives in `/samples`: what `extra` in `[[bus.drive]]` asks for, by name, unit and scale.

Velocities and following errors are scaled as the position is, currents and torques by the rule of their object, anything
else as the description says, or not at all. Values are those of the motor.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Ints
from ..errors import Place
from ..protocol import EFFORT_OBJECTS, RULES, ObjectEntry, Rule
from .bus import AXIS, DriveFile, ExtraFile, parse_object
from .description import Motor
from .robot import Robot

# Objects in position units, also a second (CiA 402-2), by their index on the first axis: name, unit of time.
POSITION_OBJECTS = {0x60F4: ("following error", ""), 0x606B: ("velocity demand", "/s"), 0x606C: ("velocity", "/s")}
EFFORT_NAMES = {0x6074: "torque demand", 0x6077: "torque", 0x6078: "current"}


@dataclass(frozen=True, kw_only=True)
class ExtraColumn:
    """A column of `extra` in `/samples`: `motor`, what it is called there, its unit, empty for a raw integer."""

    motor: str
    name: str
    unit: str


@dataclass(frozen=True, kw_only=True)
class ExtraObject:
    """An object that a PDO carries in addition to position and effort; value = raw · scale, in the unit of its column."""

    entry: ObjectEntry
    column: ExtraColumn
    scale: float

    def si(self, raw: Ints) -> Array:
        """Values of any shape."""
        return np.asarray(raw * self.scale, dtype=np.float64)


def extra_columns(robot: Robot) -> tuple[ExtraColumn, ...]:
    """Columns of `extra` in the samples of a robot's drives, drive by drive."""
    if robot.bus is None:
        return ()
    return tuple(
        _column(extra, file, motor)
        for file, motor in zip(robot.bus.drive, robot.motors, strict=True)
        for extra in map(_written_out, file.extra)
    )


def extra_object(written: str | ExtraFile, entry: ObjectEntry, file: DriveFile, motor: Motor, at: Place) -> ExtraObject:
    """One `extra` of a drive, resolved to `entry`; refused where its rule lacks a rated value."""
    extra = _written_out(written)
    scale, index = extra.scale, _on_first_axis(entry.index)
    if scale is None and index in POSITION_OBJECTS:
        scale = file.sign / file.counts_per_unit
    elif scale is None and entry.key in EFFORT_OBJECTS:
        rule = RULES[EFFORT_OBJECTS[entry.key][1]]
        scale = effort_scale(
            rule, file, at, f"the rated value that {entry} multiplies, or a scale and a unit for it in extra"
        )
    return ExtraObject(entry=entry, column=_column(extra, file, motor), scale=1.0 if scale is None else scale)


def effort_scale(rule: Rule, file: DriveFile, at: Place, expected: str) -> float:
    """SI per raw unit, sign included; refused where the rated value that the rule multiplies is not stated."""
    rated = getattr(file, rule.rated) if rule.rated else 1.0
    if rated is None:
        at.refuse(rule.rated, None, expected)
    return float((file.effort_sign or file.sign) * rule.factor * rated)


def _written_out(extra: str | ExtraFile) -> ExtraFile:
    return ExtraFile(object=extra) if isinstance(extra, str) else extra


def _on_first_axis(index: int) -> int:
    return index - (index - 0x6000) // AXIS * AXIS if 0x6000 <= index < 0xA000 else index


def _column(extra: ExtraFile, file: DriveFile, motor: Motor) -> ExtraColumn:
    index, sub = parse_object(extra.object)
    first, name, unit = _on_first_axis(index), f"{index:04X}:{sub}", ""
    if first in POSITION_OBJECTS:
        name, per = POSITION_OBJECTS[first]
        unit = ("rad" if file.counts_per_m is None else "m") + per
    elif (index, sub) in EFFORT_OBJECTS:
        name, unit = EFFORT_NAMES.get(index, name), RULES[EFFORT_OBJECTS[index, sub][1]].unit
    if extra.scale is not None:
        unit = extra.unit or ""
    return ExtraColumn(motor=motor.name, name=extra.name or name, unit=unit)
