"""Charts of identified friction over the speed of each joint."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Ints
from ..model import InverseModel, friction_alone
from ..regression import rigid_torque_at_rows
from ..report import FitFile, base_name
from ..results import FitOnRecording
from .colors import GREY, ORANGE, PREDICTED, SKY, VERMILLION
from .panels import Curve, Graph

# percentiles of the load that curves of friction are drawn at
LOADS = {10.0: SKY, 50.0: ORANGE, 90.0: VERMILLION}
SPEEDS = np.linspace(0.02, 1.0, 80)  # of these curves in each direction, relative to the peak
MAX_DOTS = 400  # of a friction chart


@dataclass(frozen=True, kw_only=True, eq=False)
class _Friction:
    """The fitted friction, and the rows of all recordings that show it.

    Attributes:
        model, columns: the robot, and the standard parameters of the fitted ones.
        beta, covariance: (b,) and (b, b) of the fitted parameters, and `reach`: deviations in half
            a 95 % interval.
        share: (b,) of the recordings that have a parameter.
        dq, load, residual: speeds, sizes of the links' torques and residual torques, each (K, n).
        own: (K, b) is 1 for the parameters that a row's recording has.
    """

    model: InverseModel
    columns: Ints
    beta: Array
    covariance: Array
    reach: float
    share: Array
    dq: Array
    load: Array
    residual: Array
    own: Array

    def alone(self, j: int, speed: Array, load: Array) -> Array:
        """(k, b) columns of the friction of joint j."""
        return friction_alone(self.model, self.columns, j, speed, load)


def friction_charts(
    fit: FitFile, recordings: Sequence[FitOnRecording], of: str = ""
) -> list[Graph]:
    """Friction of each joint over its speed: rows as dots, the identified curve with its 95 %
    interval; a color per load.

    Dots are the measured torque minus all other predicted torque, the offset too, in the rows of
    all recordings; in the first rows of a long one. If recordings have parameters of their own,
    dots use each recording's and curves their means.
    """
    problem, names = recordings[0].problem, [p.name for p in fit.parameters]
    places = [problem.base.names.index(base_name(name)) for name in names]
    has = np.array([[name in one.names for name in names] for one in recordings], dtype=float)
    found = []
    for one, of_one in zip(recordings, has, strict=True):
        dq, rigid = rigid_torque_at_rows(one.problem.for_errors, one.beta)
        residual = (one.tau - one.tau_predicted)[: len(dq)]
        found.append((dq, np.abs(rigid), residual, np.tile(of_one, (len(dq), 1))))
    dq, load, residual, own = (np.concatenate(x) for x in zip(*found, strict=True))
    covariance = np.array(fit.covariance.values) if fit.covariance else np.zeros((len(names),) * 2)
    half, sigma = np.array([p.half for p in fit.parameters]), np.sqrt(np.diag(covariance))
    friction = _Friction(
        model=problem.model,
        columns=problem.base.columns[places],
        beta=np.array([p.value for p in fit.parameters]),
        covariance=covariance,
        reach=float(np.median(half[sigma > 0] / sigma[sigma > 0])) if sigma.any() else 0.0,
        share=has.mean(axis=0),
        dq=dq,
        load=load,
        residual=residual,
        own=own,
    )
    return [_friction_chart(friction, j, of) for j in range(problem.signals.robot.n)]


def _friction_chart(rows: _Friction, j: int, of: str) -> Graph:
    robot, curves = rows.model.robot, list[Curve]()
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
    own = rows.alone(j, v, load) * rows.own[shown]
    points = np.stack([v, own @ rows.beta + rows.residual[shown, j]], axis=1)
    nearest = np.abs(load[:, None] - loads).argmin(axis=1)
    for k, (color, _, name) in enumerate(looks):
        for speed in (-peak * SPEEDS, peak * SPEEDS) if peak > 0 else ():
            middle, half = _friction_curve(rows, j, speed, loads[k])
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


def _friction_curve(rows: _Friction, j: int, speed: Array, load: float) -> tuple[Array, Array]:
    """Friction of joint j at speeds (k,) and a load, and half-widths of its 95 % interval."""
    G = rows.alone(j, speed, np.full(len(speed), load)) * rows.share
    variance = np.sum((G @ rows.covariance) * G, axis=1)
    return G @ rows.beta, rows.reach * np.sqrt(np.maximum(variance, 0.0))
