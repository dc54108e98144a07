"""Drive gains by instrumental variables, equation (I): the recorded effort is a regressor, its
instrument the effort that the model predicts.

    X x = Y,  X = [W L -E],  x = (beta, phi, kappa),  Y = known torques - L phi_known;
    Z = [W L -Ê]

E_m is the torque of motor m by its described gain, kappa_m the factor on it. The recorded effort is
noisy, so least squares is biased towards kappa = 0; Ê is computed from the base parameters of the
pass before. The fixed point with the measured motion in W and L needs no simulation; it starts the
passes with the simulated robot, whose X and Z have the same columns.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import estimation
from ..arrays import Array
from ..errors import BadInputError, NoFitError
from ..estimation import Estimate, Intervals, System
from ..regression import Rows, Term, base_places, rows_by_measured_motion
from ..trust import FitData, Lag, moves_of
from .equations import Equations
from .gain_results import EstimatedPayload, Gains
from .settled import leave_out_collinear_terms, leave_out_load

MAX_PASSES = 60
MAX_CHANGE = 1e-9  # of a gain, in the last pass
MIN_KNOWN_SHARE = 1e-6  # of the norm of Y, outside the span of [W L]


def motors_of(equations: Equations) -> tuple[int, ...]:
    """The motors whose gains are identified."""
    names, wanted = (
        [m.name for m in equations.problem.signals.robot.motors],
        equations.overrides.gains or (),
    )
    return (
        tuple(range(len(names)))
        if "all" in wanted
        else tuple(names.index(name) for name in dict.fromkeys(wanted))
    )


def measured_rows(equations: Equations, x: Array, further: Sequence[Term] = ()) -> list[Rows]:
    """The rows of each recording about x, with Z = [W L -Ê] of the measured motion."""
    tasks = [
        (problem, equations.unknowns.beta(x, k), further[k] if further else None)
        for k, problem in enumerate(equations.tasks())
    ]
    return list(equations.recordings.work.run(rows_by_measured_motion, tasks))


def solve_with_gains(equations: Equations) -> tuple[Equations, Array, bool]:
    """The fixed point with the measured motion: x, and whether the steps settled.

    Raises `BadInputError` if nothing determines the scale of the gains.
    """
    equations = leave_out_collinear_terms(equations.with_motors(motors_of(equations)))
    names, gains = equations.names, equations.unknowns.gains
    columns = np.setdiff1d(np.arange(len(names)), equations.load_places())
    refuse_without_scale(equations, columns)
    # Least squares by the described gains starts better than with all columns,
    # where gains may become 0.
    described = (
        equations.with_motors(()).about().system.with_columns(columns[: gains.start - len(names)])
    )
    x = np.ones(len(names))
    x[: gains.start] = estimation.weighted_least_squares(described).values_of(names[: gains.start])
    if equations.load:
        fixed, start = leave_out_load(
            equations.with_motors(()), x[: gains.start], estimation.weighted_least_squares
        )
        if fixed.left_out != equations.left_out:
            equations, x = fixed.with_motors(equations.unknowns.motors), np.r_[start, x[gains]]
            names, gains = equations.names, equations.unknowns.gains
    for _ in range(MAX_PASSES):
        rows = equations.stacked(measured_rows(equations, x))
        try:
            estimate = estimation.instrumental_variables(
                rows.system, rows.Z, joint_weights_of(rows.system, x)
            )
            estimate = equations.combined(rows.system, estimate)
        except NoFitError as error:
            raise BadInputError(
                f"drive gains and the arm cannot be separated ({error.args[0]}): the payload "
                "does not show in the recordings",
                key="gains",
                expected="a payload on one recording, and its mass as stated",
            ) from error
        before, x = x, estimate.values_of(names)
        if (np.abs(x - before)[gains] <= MAX_CHANGE * np.abs(x[gains])).all():
            return equations, x, True
    return equations, x, False


def joint_weights_of(system: System, x: Array) -> Array:
    """1/s_j (n,) of the residuals of x, N m or N."""
    rho = system.Y - system.W @ x
    s = np.sqrt(
        np.bincount(system.joint_of_row, rho**2, len(system.rows)) / np.maximum(1, system.rows)
    )
    return np.asarray(1.0 / np.where(s > 0, np.maximum(s, 1e-6 * s.max()), 1.0))


def refuse_without_scale(equations: Equations, columns: NDArray[np.intp]) -> None:
    """Refuse recordings whose known torques are no more than the robot's parameters could give."""
    rows, of = equations.about(), equations.unknowns
    system = rows.system
    W = system.W[:, np.setdiff1d(columns, np.arange(len(of.names))[of.gains])]
    Y, size = system.Y, np.linalg.norm(W, axis=0)
    A = W / np.where(size > 0, size, 1.0)
    left = np.linalg.norm(Y - A @ np.linalg.lstsq(A, Y, rcond=1e-10)[0])
    typical = np.linalg.norm(rows.tau * rows.share)
    if left > MIN_KNOWN_SHARE * max(float(np.linalg.norm(Y)), 1e-9 * float(typical)):
        return
    payloads = {one.payload for one in of.payloads}
    several = len(payloads) + any(one.payload is None for one in of.arms) > 1
    if several and any(payload.center_of_mass_m is None for payload in payloads):
        raise BadInputError(
            "an unknown mass does not determine the scale: weigh it, or fit with drive gains "
            "that are known"
            if any(payload.mass_kg is None for payload in payloads)
            else "the mass alone does not determine the scale: give its centre of mass",
            key="payload",
            expected="KG@X,Y,Z",
        )
    places = ", ".join(problem.signals.recording for problem in equations.problems)
    raise BadInputError(
        "no recording differs in payload",
        place=places,
        key="gains",
        expected="one recording without and one with a payload",
    )


def factors_of(equations: Equations, x: Array) -> Array:
    """(n,) factors on the drive gains of all motors in x."""
    factors, of = np.ones(equations.problem.signals.robot.n), equations.unknowns
    factors[list(of.motors)] = x[of.gains]
    return factors


def held_and_counted(
    equations: Equations,
    estimate: Estimate,
    each: Sequence[Rows],
    system: System,
    lags: Sequence[Lag],
) -> Intervals:
    """Intervals that include how well lags, stated drive gains, masses, and centres of mass
    that are not estimated are known, which the estimate holds; from the rows of each
    recording, and of all.
    """
    of, found = equations.unknowns, estimation.intervals_of(system, estimate)
    # by recording, of each half-width
    robot, torques = equations.problem.robot, list[list[Array]]()
    for m, motor in enumerate(robot.motors):
        if motor.drive_gain_half_width and m not in of.motors:
            torques.append(
                [motor.drive_gain_half_width / robot.gain[m] * rows.E[:, m] for rows in each]
            )
    stated = [np.zeros(len(estimate.names))] * len(torques)  # moves of what is stated of x
    for carried in of.payloads:
        for known, x in carried.half_widths(estimate.names):
            stated.append(x)
            pairs = zip(each, of.arms, strict=True)
            torques.append(
                [rows.system.W @ (known * (arm.payload is carried)) for rows, arm in pairs]
            )
    moved = [lag.moved for lag in lags]
    if torques:
        columns = [np.transpose(of_recording) for of_recording in zip(*torques, strict=True)]
        C = np.concatenate(columns)[estimation.by_joint([rows.system for rows in each])]
        moved += list(np.abs(stated - moves_of(system, C, estimate).T) / found.reach)
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


def results_of(equations: Equations, evidence: FitData) -> dict[str, Any]:
    """The estimate of the base parameters alone, and the results of gains and
    payloads, which it includes.
    """
    of, estimate, found = equations.unknowns, evidence.estimate, evidence.intervals
    base, robot = base_places(estimate.names), equations.problem.robot
    payloads, motors, gains = [], [robot.motors[m] for m in of.motors], None
    for one in of.payloads:
        own = np.array(
            [estimate.names.index(name) for name in one.names if name in estimate.names],
            dtype=np.intp,
        )
        covariance = found.covariance[np.ix_(own, own)] if len(own) == len(one.names) else None
        values, sigma, prior = one.nearest_body(estimate.values_of(one.names), covariance)
        pairs = zip(equations.problems, of.arms, strict=True)
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
    if motors:
        at = [estimate.names.index(name) for name in of.names[of.gains]]
        assert evidence.Z is not None
        gains = Gains(
            motors=tuple(motor.name for motor in motors),
            units=tuple(
                f"{robot.effort_units[m]}/{robot.motors[m].recorded_unit}" for m in of.motors
            ),
            described=np.array([np.nan if m.gain is None else m.gain for m in motors]),
            values=robot.gain[list(of.motors)],
            half=np.abs(robot.gain[list(of.motors)]) * found.half[at],
            cragg_donald=smallest_cragg_donald(
                evidence.observed.system, evidence.Z, estimate.weights, of.gains
            ),
        )
    return {
        "estimate": estimate.part(base),
        "intervals": found.part(base),
        "gains": gains,
        "payloads": tuple(payloads),
    }
