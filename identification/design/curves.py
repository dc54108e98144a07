"""Friction torque over speed and load, joint by joint: what a fit leaves for friction in its rows, and its curve."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..methods import Fit, FittedRecording
from ..model import friction_alone
from ..regression import base_name, links_at_rows

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
    """Friction of each joint as a fit has it, in the rows of all its recordings; of a long recording its first rows.

    Where recordings have parameters of their own, the rows are each recording's and the curve is that of their means.
    """
    problem, robot, names = fit.problem, fit.problem.signals.robot, fit.estimate.names
    columns = problem.base.columns[[fit.base.names.index(base_name(name)) for name in names]]
    at_rows = [_rows_of(fit, one) for one in fit.recordings]
    moved, torques, residuals = (np.concatenate(x) for x in zip(*(one[:3] for one in at_rows), strict=True))
    among = np.concatenate([np.tile(own, (len(dq), 1)) for dq, _, _, own in at_rows])  # (rows, b) its own or shared
    mean = np.mean([own for *_, own in at_rows], axis=0)
    beta, covariance = fit.estimate.beta, fit.intervals.covariance
    found = []
    for j, joint in enumerate(robot.joints):
        peak = np.abs(moved[:, j]).max(initial=0.0)
        rows = np.flatnonzero(np.abs(moved[:, j]) > 0.02 * peak)
        v, load = moved[rows, j], np.abs(torques[rows, j])
        friction = (friction_alone(problem.model, columns, j, v, load) * among[rows]) @ beta
        loads = np.percentile(load, LEVELS) if "load" in joint.terms and len(load) else np.array([np.nan])
        speed = peak * np.r_[np.linspace(-1.0, -0.02, POINTS), np.linspace(0.02, 1.0, POINTS)]
        curves = []
        for level in loads:
            G = friction_alone(problem.model, columns, j, speed, np.full(len(speed), np.nan_to_num(level))) * mean
            half = fit.intervals.reach * np.sqrt(np.maximum(np.sum((G @ covariance) * G, axis=1), 0.0))
            curves.append(FrictionCurve(load=float(level), speed=speed, torque=G @ beta, half=half))
        found.append(
            JointFriction(
                joint=joint.name,
                unit=robot.effort_units[j],
                speed_unit=f"{joint.position_unit}/s",
                speed=v,
                torque=friction + residuals[rows, j],
                load=load,
                curves=tuple(curves),
            )
        )
    return tuple(found)


def _rows_of(fit: Fit, one: FittedRecording) -> tuple[Array, Array, Array, Array]:
    """Speeds, torques of the links and residuals (rows, n) of a recording, and which parameters (b,) are its own or shared."""
    dq, rigid = links_at_rows(one.problem, fit.estimate.among(one.parameters))
    residual = (fit.tau - fit.tau_predicted)[one.rows][: len(dq)]
    return dq, rigid, residual, np.array([name in one.parameters for name in fit.estimate.names], dtype=float)
