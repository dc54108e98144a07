"""Drive gains in a fit, equation (I): the recorded effort is a regressor, its instrument the effort
that the model predicts.

E_m is the torque of motor m by its described gain, kappa_m the factor on it: a term `Drives` like
the others. What is stated of gains, masses and centres of mass has half-widths, which intervals
count.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from .. import estimation
from ..arrays import Array
from ..estimation import Estimate, Intervals, System
from ..regression import Lag, Rows, base_places
from ..report import DriveGain, FTest
from ..trust import FitData
from .fit import Pass
from .gain_results import EstimatedPayload
from .model import Model

MAX_GAIN_SHARE = 0.1  # half an interval over the gain: with more it is not determined


def held_and_counted(
    model: Model, estimate: Estimate, rows: Rows, lags: Sequence[Lag]
) -> Intervals:
    """Intervals that include how well lags, stated drive gains, masses, and centres of mass
    that are not estimated are known, which the estimate holds.
    """
    of, found = model.unknowns, estimation.intervals_of(rows.system, estimate)
    moved = [lag.moved for lag in lags]
    if of.held:
        places = [of.names.index(name) for name in estimate.names]
        half = np.array([[one.half] for one in of.held])
        moves = estimation.moves_of(rows.system, rows.L[:, : len(of.held)], estimate).T
        stated = np.array([one.stated[places] for one in of.held])
        moved += list(half * np.abs(stated - moves) / found.reach)
    return estimation.intervals_from(
        estimate, np.hypot.reduce([found.sigma, *moved]), found.freedom
    )


def smallest_cragg_donald(system: System, Z: Array, weights: Array, gains: slice) -> float:
    """Smallest eigenvalue of the Cragg-Donald statistic of (E, Ê) projected off W
    and L, per instrument.

    Cragg, Donald, Testing identifiability and specification in instrumental variable models,
    Econometric Theory 9 (1993). First-stage F of a gain is blind: W explains the current.
    """
    w = weights[system.joint_of_row][:, None]
    others, E, known = np.delete(Z, gains, axis=1) * w, system.W[:, gains] * w, Z[:, gains] * w
    basis = np.linalg.qr(others / np.maximum(np.linalg.norm(others, axis=0), 1e-300))[0]
    E, known = (x - basis @ (basis.T @ x) for x in (E, known))
    Q = np.linalg.qr(known)[0]
    explained = Q.T @ E
    left = E - Q @ explained
    m, freedom = E.shape[1], float(system.rows.sum()) - Z.shape[1]
    root = np.linalg.cholesky(left.T @ left / max(1.0, freedom) + 1e-300 * np.eye(m))
    half = np.linalg.solve(root, explained.T)
    return float(np.linalg.eigvalsh(half @ half.T)[0] / m)


def results_of(model: Model, evidence: FitData, ls: Pass, essential: FTest) -> dict[str, Any]:
    """The estimates of the base parameters alone, with their essential ones, and the results of
    gains and payloads, which they include.
    """
    of, estimate, found = model.unknowns, evidence.estimate, evidence.intervals
    base, of_ls = base_places(estimate.names), base_places(ls.estimate.names)
    robot, kept = model.problem.signals.robot, base_places(essential.names)
    payloads, gains, cragg_donald = [], list[DriveGain](), None
    for one in of.payloads:
        own = np.array(
            [estimate.names.index(name) for name in one.names if name in estimate.names],
            dtype=np.intp,
        )
        covariance = found.covariance[np.ix_(own, own)] if len(own) == len(one.names) else None
        values, sigma, prior = one.nearest_body(estimate.values_of(one.names), covariance)
        pairs = zip(model.problems, of.arms, strict=True)
        name = next(problem.signals.recording for problem, arm in pairs if arm.payload is one)
        half = found.reach * sigma
        payloads.append(
            EstimatedPayload(
                recording=name,
                payload=one.payload,
                values=values,
                half=half,
                from_prior=prior,
                near=not one.names or bool(half.any()),
            )
        )
    for m, name in zip(of.motors, of.names[of.gains], strict=True):
        motor, at = robot.motors[m], estimate.names.index(name)
        value = float(robot.gain[m] * estimate.beta[at])
        width = float(np.abs(robot.gain[m]) * found.half[at])
        gains.append(
            DriveGain(
                motor=motor.name,
                unit=f"{robot.effort_units[m]}/{motor.recorded_unit}",
                described=motor.gain,
                value=value,
                half_width=width,
                determined=width < MAX_GAIN_SHARE * abs(value),
            )
        )
    if gains:
        cragg_donald = smallest_cragg_donald(
            evidence.observed.system, evidence.Z, estimate.weights, of.gains
        )
    return {
        "estimate": estimate.part(base),
        "intervals": found.part(base),
        "least_squares": replace(
            ls, estimate=ls.estimate.part(of_ls), intervals=ls.intervals.part(of_ls)
        ),
        "essential": msgspec.structs.replace(
            essential, names=tuple(essential.names[k] for k in kept)
        ),
        "gains": tuple(gains),
        "cragg_donald": cragg_donald,
        "payloads": tuple(payloads),
    }
