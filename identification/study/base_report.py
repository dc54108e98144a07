"""Base parameters of a robot, and the values that a recording was simulated with, as a document and as a file."""

import msgspec
from msgspec import UNSET, UnsetType

from acquisition.robot import Robot

from ..arrays import Array
from ..model import BaseParameters
from ..report import Document, Number, ResultFile, Section, Table, columns


class BaseParameter(msgspec.Struct, frozen=True, kw_only=True):
    """A base parameter, its sum of standard parameters, and its value if known."""

    name: str
    expression: str
    unit: str
    value: float | UnsetType = UNSET


class BaseFile(ResultFile, frozen=True, kw_only=True):
    """The JSON file of a robot's base parameters, or of the values that a recording was simulated with."""

    robot: str
    joint_names: list[str]  # of joints 1, 2, ...: names of parameters end with this number
    parameters: list[BaseParameter]


def base_file(base: BaseParameters, robot: Robot, true: Array | None = None) -> BaseFile:
    """The JSON file of base parameters; arguments as of `base_document`."""
    values: list[float | UnsetType] = [UNSET] * base.b if true is None else [float(x) for x in true]
    parameters = [
        BaseParameter(name=name, expression=expression, unit=unit, value=value)
        for name, expression, unit, value in zip(base.names, base.expressions, base.units, values, strict=True)
    ]
    return BaseFile(robot=robot.name, joint_names=[joint.name for joint in robot.joints], parameters=parameters)


def base_document(base: BaseParameters, robot: Robot, true: Array | None = None) -> Document:
    """The base parameters of a robot as sums of standard parameters, in short the regrouped ones; its joints by number."""
    names = zip(base.names, base.expressions, base.units, strict=True)
    values: list[tuple[Number, ...]] = [()] * base.b if true is None else [(Number(float(x), ".6g"),) for x in true]
    table = Table(
        columns=columns("name", "expression", "unit", numbers=() if true is None else ("value",)),
        rows=tuple((*row, *value) for row, value in zip(names, values, strict=True)),
    )
    joints = Table(
        columns=columns("number", "joint", "type"),
        rows=tuple((str(j + 1), joint.name, joint.type) for j, joint in enumerate(robot.joints)),
    )
    sums_first = sorted(range(base.b), key=lambda k: base.expressions[k] == base.names[k])
    parameters = Section(table=table).with_short_table(sums_first, 20)
    sections = (parameters, Section(title="joints, by the number at the end of a name", table=joints))
    return Document(title=f"{robot.name}: {base.b} base parameters", sections=sections)
