"""Drive gains by instrumental variables: the recorded effort is a regressor, its instrument the effort that the model predicts.

    X x = Y,  X = [W L -E],  x = (beta, phi, kappa),  Y = known torques - L phi_known;    Z = [W L -Ê]

E_m is the torque of motor m by its described gain, kappa_m the factor on it. The recorded effort is noisy, so least squares is
biased towards kappa = 0; Ê is computed from the base parameters of the pass before. The fixed point with the measured motion in
W and L needs no simulation; it starts the passes with the simulated robot, whose X and Z have the same columns.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Estimate, Intervals, System, instrumental_variables, intervals_from, weighted_least_squares
from ..regression import base_places, predicted_drives
from ..trust import FitData
from .gain_results import EstimatedPayload, Gains
from .settled import leave_out_collinear_terms
from .system import StackedSystem, drives_of

MAX_PASSES = 60
MAX_CHANGE = 1e-9  # of a gain, in the last pass
MIN_KNOWN_SHARE = 1e-6  # of the norm of Y, outside the span of [W L]


def motors_of(observed: StackedSystem) -> tuple[int, ...]:
    """The motors whose gains are identified."""
    names, wanted = [m.name for m in observed.problem.signals.robot.motors], observed.overrides.gains or ()
    return tuple(range(len(names))) if "all" in wanted else tuple(names.index(name) for name in dict.fromkeys(wanted))


def measured_instruments(observed: StackedSystem, x: Array) -> Array:
    """Z = [W L -Ê] of the measured motion, about all parameters x; the rows of the system."""
    n, of = observed.regression.tau.shape[1], observed.parameters
    blocks = list[Array]()
    for k, one in enumerate(observed.observations):
        drives = predicted_drives(one.problem, of.base(x, k))
        blocks.append(of.columns(one.regression.system.W, k, drives).reshape(n, -1, len(of.names)))
    return np.concatenate(blocks, axis=1).reshape(-1, len(of.names))


def solve_with_gains(observed: StackedSystem) -> tuple[StackedSystem, Estimate, bool]:
    """The fixed point with the measured motion: the system about it, the estimate, and whether the passes settled.

    Raises `IdentificationError` if nothing tells the scale of the gains.
    """
    observed = leave_out_collinear_terms(observed.with_motors(motors_of(observed)))
    names, gains = observed.parameters.names, observed.parameters.gains
    columns = np.setdiff1d(np.arange(len(names)), observed.load_places())
    refuse_without_scale(observed, columns)
    # Least squares by the described gains starts better than that of X, whose gains may be 0.
    described = observed.with_motors(()).regression.system.with_columns(columns[: gains.start - len(names)])
    x = np.ones(len(names))
    x[: gains.start] = weighted_least_squares(described).values_of(names[: gains.start])
    for _ in range(MAX_PASSES):
        observed = observed.at(x)
        system, Z = observed.regression.system, measured_instruments(observed, x)
        try:
            estimate = instrumental_variables(system, Z, joint_weights_of(observed, x))
        except IdentificationError as error:
            text = f"the drive gains cannot be told from the arm ({error}): the payload does not show in the recordings"
            expected = "a payload on one recording, and its mass as stated"
            raise IdentificationError(text, key="gains", expected=expected) from error
        before, x = x, estimate.values_of(names)
        if (np.abs(x - before)[gains] <= MAX_CHANGE * np.abs(x[gains])).all():
            return observed, estimate, True
    return observed, estimate, False


def joint_weights_of(observed: StackedSystem, x: Array) -> Array:
    """1/s_j (n,) of the residuals of all parameters x, N m or N."""
    system = observed.regression.system
    rho = (system.Y - system.W @ x) * system.used
    s = np.sqrt(np.bincount(system.joint_of_row, weights=rho**2) / np.maximum(1, system.rows))
    return np.asarray(1.0 / np.where(s > 0, np.maximum(s, 1e-6 * s.max()), 1.0))


def refuse_without_scale(observed: StackedSystem, columns: NDArray[np.intp]) -> None:
    """Refuse recordings whose known torques are no more than the robot's parameters could give."""
    system, of = observed.regression.system, observed.parameters
    W = system.W[:, np.setdiff1d(columns, np.arange(len(of.names))[of.gains])] * system.used[:, None]
    Y, size = system.Y * system.used, np.linalg.norm(W, axis=0)
    A = W / np.where(size > 0, size, 1.0)
    left = np.linalg.norm(Y - A @ np.linalg.lstsq(A, Y, rcond=1e-10)[0])
    typical = np.linalg.norm(observed.regression.tau * observed.regression.share)
    if left > MIN_KNOWN_SHARE * max(float(np.linalg.norm(Y)), 1e-9 * float(typical)):
        return
    payloads = {one.payload.payload for one in of.of if one.payload is not None}
    several = len(payloads) + any(one.payload is None for one in of.of) > 1
    if several and any(payload.center_of_mass_m is None for payload in payloads):
        text = "the mass alone does not tell the scale: give its centre of mass"
        if any(payload.mass_kg is None for payload in payloads):
            text = "of an unknown mass no scale can be told: weigh it, or fit with drive gains that are known"
        raise IdentificationError(text, key="payload", expected="KG@X,Y,Z")
    places = ", ".join(one.problem.signals.recording for one in observed.observations)
    text = "no recording differs in payload"
    raise IdentificationError(text, place=places, key="gains", expected="one recording without and one with a payload")


def factors_of(observed: StackedSystem, estimate: Estimate) -> Array:
    """(n,) factors on the drive gains of all motors by an estimate."""
    factors, of = np.ones(observed.regression.tau.shape[1]), observed.parameters
    factors[list(of.motors)] = estimate.values_of(of.names)[of.gains]
    return factors


def extended(observed: StackedSystem, x: Array, C: Array | None) -> tuple[Array, Array | None]:
    """Values and covariance of all parameters, gains as described, from those without gains."""
    m = len(observed.parameters.motors)
    wide = None if C is None else np.pad(C, ((0, m), (0, m)))
    return np.r_[x, np.ones(m)], wide


def add_scale_variance(observed: StackedSystem, estimate: Estimate, found: Intervals) -> Intervals:
    """Intervals that include how well stated masses and stated drive gains are known."""
    of, rows, parts = observed.parameters, observed.regression, observed.observations
    robot = observed.problem.signals.robot
    stated = [m for m, motor in enumerate(robot.motors) if motor.drive_gain_half_width and m not in of.motors]
    drives, moved = drives_of(parts) if stated else [], list[list[Array]]()  # torques, by recording, of each half-width
    for m in stated:
        share = (robot.motors[m].drive_gain_half_width or 0.0) / robot.gain[m]
        moved.append([share * each[..., m].reshape(-1) for each in drives])
    for carried in dict.fromkeys(one.payload for one in of.of if one.payload is not None):
        if carried.payload.mass_half_width_kg and carried.payload.mass_kg:
            known = carried.payload.mass_half_width_kg / carried.payload.mass_kg * carried.known
            moved.append(
                [
                    one.regression.system.W @ (known * (own.payload is carried))
                    for one, own in zip(parts, of.of, strict=True)
                ]
            )
    if not moved or rows.reduced:
        return found
    weight = estimate.weights[rows.system.joint_of_row] * rows.system.used
    each = [
        np.concatenate([x.reshape(rows.tau.shape[1], -1) for x in one], axis=1).reshape(-1) * weight for one in moved
    ]
    moves = estimate.bread @ (estimate.Q.T @ np.transpose(each))
    sigma = np.hypot.reduce([found.sigma, *np.abs(moves.T) / found.reach])
    return intervals_from(estimate, sigma, found.freedom)


def smallest_cragg_donald(system: System, Z: Array, weights: Array, gains: slice) -> float:
    """Smallest eigenvalue of the Cragg-Donald statistic of (E, Ê) projected off W and L, per instrument.

    Cragg, Donald, Testing identifiability and specification in instrumental variable models, Econometric Theory 9 (1993).
    First-stage F of a gain is blind: W explains the current.
    """
    w = (weights[system.joint_of_row] * system.used)[:, None]
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


def results_of(observed: StackedSystem, evidence: FitData) -> dict[str, Any]:
    """The estimate of the base parameters alone, and the results of gains and payloads, which it includes."""
    of, estimate, found = observed.parameters, evidence.estimate, evidence.intervals
    base = base_places(estimate.names)
    payloads, motors, gains = [], [observed.problem.signals.robot.motors[m] for m in of.motors], None
    for one in dict.fromkeys(part.payload for part in of.of if part.payload is not None):
        own = np.array([estimate.names.index(name) for name in one.names if name in estimate.names], dtype=np.intp)
        covariance = found.covariance[np.ix_(own, own)] if len(own) == len(one.names) else None
        values, sigma, prior = one.nearest_body(estimate.values_of(one.names), covariance)
        name = next(part.problem.signals.recording for part in observed.observations if part.parameters.payload is one)
        half = found.reach * sigma
        payloads.append(
            EstimatedPayload(recording=name, payload=one.payload, values=values, half=half, from_prior=prior)
        )
    if motors:
        at, robot = [estimate.names.index(name) for name in of.names[of.gains]], observed.problem.signals.robot
        system = observed.regression.system
        assert evidence.Z is not None
        gains = Gains(
            motors=tuple(motor.name for motor in motors),
            units=tuple(f"{robot.effort_units[m]}/{robot.motors[m].recorded_unit}" for m in of.motors),
            described=np.array([np.nan if m.gain is None else m.gain for m in motors]),
            values=robot.gain[list(of.motors)],
            half=np.abs(robot.gain[list(of.motors)]) * found.half[at],
            cragg_donald=smallest_cragg_donald(system, evidence.Z, estimate.weights, of.gains),
        )
    return {"estimate": estimate.part(base), "intervals": found.part(base), "gains": gains, "payloads": tuple(payloads)}
