"""Charts of identified friction over the speed of each joint."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Ints
from ..model import friction_alone
from ..regression import base_name, rigid_torque_at_rows
from ..results import Fit
from .colors import GREY, ORANGE, PREDICTED, SKY, VERMILLION
from .panels import Curve, Graph

# percentiles of the load that curves of friction are drawn at
LOADS = {10.0: SKY, 50.0: ORANGE, 90.0: VERMILLION}
SPEEDS = np.linspace(0.02, 1.0, 80)  # of these curves in each direction, relative to the peak
MAX_DOTS = 400  # of a friction chart


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rows:
    """Rows of all recordings: speeds `dq`, sizes of the links' torques `load` and residual
    torques, each (K, n); `own` (K, b) is 1 for the parameters that a row's recording has.
    """

    dq: Array
    load: Array
    residual: Array
    own: Array


def friction_charts(fit: Fit, of: str = "") -> list[Graph]:
    """Friction of each joint over its speed: rows as dots, the identified curve with its 95 %
    interval; a color per load.

    Dots are the measured torque minus all other predicted torque, the offset too, in the rows of
    all recordings; in the first rows of a long one. If recordings have parameters of their own,
    dots use each recording's and curves their means.
    """
    names = [base_name(name) for name in fit.estimate.names]
    columns = fit.problem.base.columns[[fit.base.names.index(name) for name in names]]
    found = []
    for one in fit.recordings:
        dq, rigid = rigid_torque_at_rows(one.problem.for_errors, one.arm.values(fit.estimate))
        residual = (one.tau - one.tau_predicted)[: len(dq)]
        has = [float(name in one.arm.names) for name in fit.estimate.names]
        found.append((dq, np.abs(rigid), residual, np.tile(has, (len(dq), 1))))
    dq, load, residual, own = (np.concatenate(x) for x in zip(*found, strict=True))
    rows = _Rows(dq=dq, load=load, residual=residual, own=own)
    return [_friction_chart(fit, columns, rows, j, of) for j in range(fit.problem.signals.robot.n)]


def _friction_chart(fit: Fit, columns: Ints, rows: _Rows, j: int, of: str) -> Graph:
    robot, curves = fit.problem.signals.robot, list[Curve]()
    joint, unit = robot.joints[j], robot.effort_units[j]
    peak = np.abs(rows.dq[:, j]).max(initial=0.0)
    moving = np.flatnonzero(np.abs(rows.dq[:, j]) > 0.02 * peak)
    loads, looks = [0.0], [(PREDICTED, GREY, "identified")]
    if "load" in joint.terms and len(moving):
        loads = np.percentile(rows.load[moving, j], list(LOADS)).tolist()
        looks = [
            (color, color, f"load {x:.3g} {unit}")
            for x, color in zip(loads, LOADS.values(), strict=True)
        ]
    shown = moving[:: max(1, len(moving) // MAX_DOTS)]
    v, load = rows.dq[shown, j], rows.load[shown, j]
    own = friction_alone(fit.problem.model, columns, j, v, load) * rows.own[shown]
    points = np.stack([v, own @ fit.estimate.beta + rows.residual[shown, j]], axis=1)
    nearest = np.abs(load[:, None] - loads).argmin(axis=1)
    for k, (color, _, name) in enumerate(looks):
        for speed in (-peak * SPEEDS, peak * SPEEDS) if peak > 0 else ():
            middle, half = _friction_curve(fit, columns, j, speed, loads[k])
            for side, text in ((0, name), (-1, "95 % interval"), (1, "95 % interval")):
                curves.append(
                    Curve(
                        key=f"{k}{len(curves):02}",
                        name=text,
                        color=color,
                        line=(speed, middle + side * half),
                        width=1.0 if side else 2.5,
                        dashed=bool(side),
                    )
                )
    return Graph(
        path=("friction", joint.name, *([of] if of else [])),
        title=f"friction {joint.name}{of and f', {of}'} [{unit}] over speed "
        f"[{joint.position_unit}/s]",
        curves=tuple(curves),
        dots=[(points[nearest == k], color) for k, (_, color, _) in enumerate(looks)],
    )


def _friction_curve(
    fit: Fit, columns: Ints, j: int, speed: Array, load: float
) -> tuple[Array, Array]:
    """Friction of joint j at speeds (k,) and a load, and half-widths of its 95 % interval."""
    share = np.mean(
        [[name in one.arm.names for name in fit.estimate.names] for one in fit.recordings], axis=0
    )
    G = friction_alone(fit.problem.model, columns, j, speed, np.full(len(speed), load)) * share
    variance = np.sum((G @ fit.intervals.covariance) * G, axis=1)
    return G @ fit.estimate.beta, fit.intervals.reach * np.sqrt(np.maximum(variance, 0.0))
