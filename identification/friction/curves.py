"""Friction torque over speed and load, joint by joint: what a fit leaves for friction in its rows, and its curve."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..methods import Fit
from ..model import friction_alone
from ..passes import links_at_rows
from ..regression import base_name

POINTS = 80  # of a curve, each way
LEVELS = (10.0, 50.0, 90.0)  # percentiles of the load at which curves are given


@dataclass(frozen=True, kw_only=True, eq=False)
class FrictionCurve:
    """Friction of a joint at a load: `torque` (m,) over the speeds `speed` (m,), with half its 95 % interval, `half` (m,)."""

    load: float
    speed: Array
    torque: Array
    half: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class JointFriction:
    """Friction of a joint in the rows that count, and as it was identified.

    Attributes:
        joint, unit, speed_unit: its name, and the units.
        speed, torque, load: (k,) of the rows; torque is what is measured less all else that the fit predicts, offset included.
        curves: one for a joint without load friction, whose load is nan; else at a low, the middle and a high load.
    """

    joint: str
    unit: str
    speed_unit: str
    speed: Array
    torque: Array
    load: Array
    curves: tuple[FrictionCurve, ...]


def friction_of_joints(fit: Fit) -> tuple[JointFriction, ...]:
    """Friction of each joint as a fit has it; of a long recording its first rows."""
    problem, robot = fit.problem, fit.problem.signals.robot
    own = np.array([name in fit.recordings[0].parameters for name in fit.estimate.names])  # others' are of others
    names = [base_name(name) for name, is_own in zip(fit.estimate.names, own, strict=True) if is_own]
    columns = problem.base.columns[[fit.base.names.index(name) for name in names]]
    beta, covariance = fit.estimate.beta[own], fit.intervals.covariance[np.ix_(own, own)]
    dq, rigid = links_at_rows(problem, fit.beta)
    residual = (fit.rows.tau - fit.rows.tau_predicted)[: len(dq)]
    found = []
    for j, joint in enumerate(robot.joints):
        peak = np.abs(dq[:, j]).max(initial=0.0)
        rows = np.flatnonzero(np.abs(dq[:, j]) > 0.02 * peak)
        v, load = dq[rows, j], np.abs(rigid[rows, j])
        friction = friction_alone(problem.model, columns, j, v, load) @ beta
        loads = np.percentile(load, LEVELS) if "load" in joint.terms and len(load) else np.array([np.nan])
        speed = peak * np.r_[np.linspace(-1.0, -0.02, POINTS), np.linspace(0.02, 1.0, POINTS)]
        curves = []
        for level in loads:
            G = friction_alone(problem.model, columns, j, speed, np.full(len(speed), np.nan_to_num(level)))
            half = fit.intervals.reach * np.sqrt(np.maximum(np.sum((G @ covariance) * G, axis=1), 0.0))
            curves.append(FrictionCurve(load=float(level), speed=speed, torque=G @ beta, half=half))
        found.append(
            JointFriction(
                joint=joint.name,
                unit=robot.effort_units[j],
                speed_unit=f"{joint.position_unit}/s",
                speed=v,
                torque=friction + residual[rows, j],
                load=load,
                curves=tuple(curves),
            )
        )
    return tuple(found)
