"""Further objects of drives in `/samples`: what `extra` in `[[bus.drive]]` asks for, by name, unit and scale.

Velocities and following errors are scaled as the position is, currents and torques by the rule of their object, anything
else as the description says, or not at all. Values are those of the motor.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Ints
from ..errors import AcquisitionError
from ..protocol import EFFORT_OBJECTS, RULES, ObjectEntry
from .bus import DriveFile, ExtraFile, parse_object
from .description import Motor
from .robot import Robot

# Objects in position units, and in position units a second (CiA 402-2), by their index on the first axis.
IN_POSITION_UNITS = {0x60F4: ("following error", "")}
IN_SPEED_UNITS = {0x606B: ("velocity demand", "/s"), 0x606C: ("velocity", "/s")}
EFFORT_NAMES = {0x6074: "torque demand", 0x6077: "torque", 0x6078: "current"}
AXIS = 0x800  # from the objects of one axis to those of the next


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


def extra_object(
    written: str | ExtraFile, entry: ObjectEntry, file: DriveFile, motor: Motor, place: str, key: str
) -> ExtraObject:
    """One `extra` of the drive at `key`, resolved to `entry`. Raises `AcquisitionError` where its rule lacks a rated value."""
    extra = _written_out(written)
    column = _column(extra, file, motor)
    if extra.scale is not None:
        return ExtraObject(entry=entry, column=column, scale=extra.scale)
    index, _ = _on_first_axis(extra)
    if index in IN_POSITION_UNITS or index in IN_SPEED_UNITS:
        counts_per_unit = file.counts_per_m or (file.counts_per_turn or 0.0) / (2 * np.pi)
        return ExtraObject(entry=entry, column=column, scale=file.sign / counts_per_unit)
    known = EFFORT_OBJECTS.get((entry.index, entry.sub))
    if known is None:
        return ExtraObject(entry=entry, column=column, scale=1.0)
    rule = RULES[known.rule]
    rated = getattr(file, rule.rated) if rule.rated else 1.0
    if rated is None:
        expected = f"the rated value that {entry} multiplies, or a scale and a unit for it in extra"
        raise AcquisitionError(place=place, key=f"{key}.{rule.rated}", value=None, expected=expected)
    return ExtraObject(entry=entry, column=column, scale=(file.effort_sign or file.sign) * rule.factor * rated)


def _written_out(extra: str | ExtraFile) -> ExtraFile:
    return ExtraFile(object=extra) if isinstance(extra, str) else extra


def _on_first_axis(extra: ExtraFile) -> tuple[int, int]:
    index, sub = parse_object(extra.object)
    return (index - (index - 0x6000) // AXIS * AXIS if 0x6000 <= index < 0xA000 else index), sub


def _column(extra: ExtraFile, file: DriveFile, motor: Motor) -> ExtraColumn:
    index, sub = _on_first_axis(extra)
    name, unit = f"{parse_object(extra.object)[0]:04X}:{sub}", ""
    if index in IN_POSITION_UNITS or index in IN_SPEED_UNITS:
        name, per = (IN_POSITION_UNITS | IN_SPEED_UNITS)[index]
        unit = ("rad" if file.counts_per_m is None else "m") + per
    elif (known := EFFORT_OBJECTS.get(parse_object(extra.object))) is not None:
        name, unit = EFFORT_NAMES.get(index, name), RULES[known.rule].unit
    if extra.scale is not None:
        unit = extra.unit or ""
    return ExtraColumn(motor=motor.name, name=extra.name or name, unit=unit)
