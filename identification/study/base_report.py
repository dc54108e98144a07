"""Base parameters of a robot, and the values that a recording was simulated with, as a document and as a file."""

from typing import Any

from acquisition.robot import Robot

from ..arrays import Array
from ..model import BaseParameters
from ..report import Document, Section, Table, columns


def base_file(base: BaseParameters, robot: Robot, true: Array | None = None) -> dict[str, Any]:
    """The JSON file of base parameters, or of the `true` values (b,) that a recording was simulated with.

    Names of parameters end with the number of their joint, from 1 in the order of `joint_names`.
    """
    rows = zip(base.names, base.expressions, base.units, strict=True)
    parameters = [dict(zip(("name", "expression", "unit"), row, strict=True)) for row in rows]
    for parameter, value in zip(parameters, () if true is None else true.tolist(), strict=False):
        parameter["value"] = value
    return {"robot": robot.name, "joint_names": [joint.name for joint in robot.joints], "parameters": parameters}


def base_document(base: BaseParameters, robot: Robot) -> Document:
    """The base parameters of a robot as sums of standard parameters, in short the regrouped ones; its joints by number."""
    rows = tuple(zip(base.names, base.expressions, base.units, strict=True))
    table = Table(columns=columns("name", "expression", "unit"), rows=rows)
    joints = Table(
        columns=columns("number", "joint", "type"),
        rows=tuple((str(j + 1), joint.name, joint.type) for j, joint in enumerate(robot.joints)),
    )
    sums_first = sorted(range(base.b), key=lambda k: base.expressions[k] == base.names[k])
    parameters = Section(table=table).with_short_table(sums_first, 20)
    sections = (parameters, Section(title="joints, by the number at the end of a name", table=joints))
    return Document(title=f"{robot.name}: {base.b} base parameters", sections=sections)
