"""Friction of a fit over speed and load, joint by joint, as it is drawn beside the rows."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..methods import Fit
from ..model import friction_alone
from ..regression import base_name, rigid_torque_at_rows

POINTS = 80  # of a curve, in each direction
LEVELS = (10.0, 50.0, 90.0)  # percentiles of the load at which curves are drawn


@dataclass(frozen=True, kw_only=True, eq=False)
class FrictionCurve:
    """Friction of a joint at a load: `torque` (m,) over the speeds `speed` (m,), with half its 95 % interval, `half` (m,)."""

    load: float
    speed: Array
    torque: Array
    half: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class JointFriction:
    """Measured and identified friction of a joint, in the rows that count.

    Attributes:
        speed, torque, load: (k,) of the rows; torque is the measured one minus all other predicted torque (the offset too).
        curves: without load friction one, of load NaN; else at a low, a middle and a high load.
    """

    joint: str
    unit: str
    speed_unit: str
    speed: Array
    torque: Array
    load: Array
    curves: tuple[FrictionCurve, ...]


def friction_of_joints(fit: Fit) -> tuple[JointFriction, ...]:
    """Friction of each joint by a fit, in the rows of all its recordings; in the first rows of a long recording.

    If recordings have parameters of their own, rows use each recording's and the curve uses their means.
    """
    problem, names, beta, found = fit.problem, fit.estimate.names, fit.estimate.beta, []
    model, robot = problem.model, problem.signals.robot
    columns = problem.base.columns[[fit.base.names.index(base_name(name)) for name in names]]
    applies = np.array([[name in one.parameters.names for name in names] for one in fit.recordings], dtype=float)
    for one, own in zip(fit.recordings, applies, strict=True):
        dq, rigid = rigid_torque_at_rows(one.problem, one.parameters.values(fit.estimate))
        residual = (fit.tau - fit.tau_predicted)[one.rows][: len(dq)]
        found.append((dq, np.abs(rigid), residual, np.tile(own, (len(dq), 1))))
    moved, loads, residuals, own = (np.concatenate(x) for x in zip(*found, strict=True))

    def curve(j: int, peak: float, load: float) -> FrictionCurve:
        speed = peak * np.r_[np.linspace(-1.0, -0.02, POINTS), np.linspace(0.02, 1.0, POINTS)]
        G = friction_alone(model, columns, j, speed, np.full(len(speed), np.nan_to_num(load))) * applies.mean(axis=0)
        half = fit.intervals.reach * np.sqrt(np.maximum(np.sum((G @ fit.intervals.covariance) * G, axis=1), 0.0))
        return FrictionCurve(load=load, speed=speed, torque=G @ beta, half=half)

    joints = []
    for j, joint in enumerate(robot.joints):
        peak = np.abs(moved[:, j]).max(initial=0.0)
        rows = np.flatnonzero(np.abs(moved[:, j]) > 0.02 * peak)
        v, load = moved[rows, j], loads[rows, j]
        levels = np.percentile(load, LEVELS).tolist() if "load" in joint.terms and len(load) else [np.nan]
        joints.append(
            JointFriction(
                joint=joint.name,
                unit=robot.effort_units[j],
                speed_unit=f"{joint.position_unit}/s",
                speed=v,
                torque=(friction_alone(model, columns, j, v, load) * own[rows]) @ beta + residuals[rows, j],
                load=load,
                curves=tuple(curve(j, peak, level) for level in levels),
            )
        )
    return tuple(joints)
