"""Iteration of the instrumental variable method: start, next values to
simulate, end, and its status.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..errors import BadInputError, NoFitError
from ..estimation import Estimate, InstrumentTests, System, instrument_tests, intervals_of
from ..model import BaseParameters, InverseModel, direct_model, poses_of, why_not_positive
from ..regression import Term
from ..report import DirectModelResidual, Status
from ..simulation import Simulated, controller_of
from ..trust import covariance_of_all
from .equations import Equations, Robots, simulate_all
from .fit import LeastSquares, Pass, join_reasons
from .settled import least_squares

# a larger error of the simulated position does not confirm the estimate
MAX_TRACKING_PERCENT = 20.0
# passes; later ones simulate the mean of the last two values, which damps oscillation
MAX_FULL_STEPS = 4


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """Settings of the iteration.

    `start`: `regular` (only a regular inertia matrix), `ls`, or the name of the source of the
        base parameters `values`.
    `tolerance_percent`, `max_iterations`: in place of the keys of robot.toml. `inertias` (n,) are
    those of the regular start, 1 kg m² (or kg) by default.
    """

    start: str = "ls"
    tolerance_percent: float | None = None
    max_iterations: int | None = None
    values: Callable[[BaseParameters], Array] | None = None
    inertias: Array | None = None
    gain_update: bool = True

    def __post_init__(self) -> None:
        if self.inertias is not None and self.start != "regular":
            raise BadInputError(key="start", value=self.start, expected="regular, for inertias")


def start_values(
    equations: Equations, iteration: Iteration, ls: LeastSquares
) -> tuple[Array, Array | None, Array | None]:
    """Values of x to start from, least squares, their covariance, and what is simulated first in
    their place: neither a regular start nor given values give the torques by which a lag is found.
    """
    problem, repeated = equations.problem, equations.unknowns.repeated
    x = ls.full.values_of(equations.names)
    if iteration.start == "regular" and iteration.values is None:
        return x, None, repeated(regular_start(problem.model, problem.base, iteration.inertias))
    C = covariance_of_all(
        equations.names, ls.full, intervals_of(equations.about(x).system, ls.full), ls.full
    )
    return x, C, None if iteration.values is None else repeated(iteration.values(problem.base))


def next_values(passes: Sequence[Pass], names: tuple[str, ...]) -> Array:
    """Parameters (b,) to simulate next: the estimate, or in later passes its
    mean with the last values.
    """
    beta = passes[-1].estimate.values_of(names)
    return 0.5 * (beta + passes[-1].x) if len(passes) >= MAX_FULL_STEPS else beta


@np.errstate(over="ignore", invalid="ignore")  # a start may be anything
def assess_pass(
    x: Array,
    z: tuple[Simulated, ...],
    estimate: Estimate,
    system: System,
    covariances: tuple[Array | None, Array],
    *,
    tolerance_percent: float,
) -> Pass:
    """The pass that gave `estimate` with instruments `z` about x, its changes, and whether it
    settled; `system` has all parameters, `covariances` are those of the values simulated and the
    estimate.
    """
    # Compared with the values asked for, not with the consistent ones simulated instead. Parameters
    # near zero never settle in percent: half a deviation is enough.
    tolerance = 0.01 * tolerance_percent
    old = np.array([x[system.names.index(name)] for name in estimate.names])
    change = np.abs(estimate.beta - old)
    w = estimate.weights[system.joint_of_row]
    norm_before = float(np.linalg.norm(w * (system.Y - system.W @ x)))
    norm_change = abs(estimate.residual_norm - norm_before)
    with np.errstate(divide="ignore", invalid="ignore"):
        in_sigma = np.where(change > 0, change / estimate.sigma, 0.0)
        in_percent = np.where(
            np.abs(estimate.beta) > 2 * estimate.sigma, 100 * change / np.abs(estimate.beta), 0.0
        )
    return Pass(
        x=x,
        z=z,
        estimate=estimate,
        asked=covariances[0],
        covariance=covariances[1],
        change_sigma=float(in_sigma.max()),
        change_percent=float(in_percent.max()),
        changed=estimate.names[int(in_sigma.argmax())],
        residual_percent=100 * norm_change / norm_before if norm_before > 0 else 0.0,
        residual_settled=norm_change <= tolerance * norm_before,
        parameters_settled=bool(
            (change <= np.maximum(tolerance * np.abs(estimate.beta), estimate.sigma / 2)).all()
        ),
    )


class NoEstimateError(Exception):
    """Instruments gave no estimate: the cause, and why they are not of the
    simulated robot, if so.
    """


def failed(passes: list[Pass], error: NoEstimateError, recordings: Sequence[str]) -> list[Pass]:
    """The passes; the last one has the reason why the next gave no estimate.

    Raises `NoFitError` if there is none.
    """
    text = "; ".join(
        [
            f"pass {len(passes) + 1}: {error.__cause__}",
            *(str(reason) for reason in error.args if reason),
        ]
    )
    if not passes:
        raise NoFitError(f"no instruments: {text}", place=", ".join(recordings)) from error
    return [*passes[:-1], replace(passes[-1], failure=text)]


def conclude(
    equations: Equations,
    robots: Robots,
    passes: Sequence[Pass],
    further: Callable[[Array], Sequence[Term]],
    solve: Callable[[Sequence[Simulated]], Estimate],
) -> Pass:
    """The last pass if it settled; else the one whose estimate, simulated in the next pass, tracks
    best at its worst joint.

    It has its instruments, and the robot simulated with its estimate, or with the values that it
    settled at. `further`: as of `simulate_all`, about given values.
    """
    last = passes[-1]
    if last.is_last and last.failure is None:
        return replace(last, confirmed_by=last.z)

    def simulated(estimate: Estimate, covariance: Array) -> tuple[Simulated, ...]:
        x = estimate.values_of(equations.names)
        return simulate_all(equations, robots, x, (x, covariance))

    after = simulated(last.estimate, last.covariance)
    tracked = [_tracking(one.z) for one in passes[1:]] + [_tracking(after)]
    best = passes[int(np.argmin(tracked)) if min(tracked) < np.inf else -1]
    if best is last and last.failure is None:
        return replace(last, confirmed_by=after)
    x, asked = best.x, (best.x if best.robot is None else best.robot, best.asked)
    z = simulate_all(equations, robots, x, asked, further=further(x))
    estimate = solve(z)
    if best is not last:
        after = simulated(estimate, best.covariance)
    return replace(best, z=z, estimate=estimate, confirmed_by=after)


def _tracking(z: Sequence[Simulated]) -> float:
    """Position error of the worst joint, percent; infinite where the estimate
    itself was not simulated.
    """
    if any(one.kind != "simulated" for one in z):
        return np.inf
    joints = [joint.position_error_percent for one in z for joint in one.by_joint]
    return max((x for x in joints if x is not None), default=0.0)


def status_of(
    equations: Equations, passes: Sequence[Pass], best: Pass, tests: InstrumentTests
) -> tuple[Status, str | None]:
    """`converged` needs settled passes, simulated instruments that explain W, and a simulation
    that tracks the recording; or instruments along the motion that the reference predicts which
    stand alone, and explain W.

    Other settled passes are `not_confirmed`. Every joint has to track: the mean over the robot
    would hide a joint of small travel.
    """
    last = passes[-1]
    unconfirmed = None if best.by_reference else _unconfirmed(equations, best)
    if last.failure is not None:
        return "diverged", last.failure
    if not tests.first_stage_F >= 1.0:
        return (
            "diverged",
            "the simulated motion does not resemble the measured one: first-stage "
            f"F = {tests.first_stage_F:.2g}",
        )
    if best.by_reference:
        return "converged", f"instruments: reference; {best.by_reference}"
    if last.is_last:
        if unconfirmed is None and last.kind != "simulated":
            unconfirmed = f"settled without simulated instruments: {last.reason}"
        return ("converged", None) if unconfirmed is None else ("not_confirmed", unconfirmed)
    if unconfirmed is not None:
        return "diverged", unconfirmed
    moving = []
    if not last.parameters_settled:
        moving.append(f"{last.changed} still changes by {last.change_sigma:.2g} sigma")
    if not last.residual_settled:
        moving.append(f"the residual norm still changes by {last.residual_percent:.2g} %")
    still = " and ".join(moving) or "only the start is known"
    return "max_iterations", f"after {len(passes)} passes {still}"


def why_by_reference(equations: Equations, passes: Sequence[Pass], best: Pass) -> str | None:
    """Why instruments have to be along the motion that the reference predicts; None where those of
    the pass are enough, the control law is described, or the reference is not recorded.
    """
    if any(
        problem.signals.q_ref is None or controller_of(problem)[1] == "described"
        for problem in equations.problems
    ):
        return None
    system = equations.along(best.z).system
    status, why = status_of(equations, passes, best, tests_of(system, best.estimate))
    return (
        None
        if status == "converged"
        else f"by a simulated robot, whose control law is not described, {status}: {why}"
    )


def _unconfirmed(equations: Equations, best: Pass) -> str | None:
    """Why the simulation with the final estimate does not confirm it; None if it does."""
    reasons = list[tuple[str, str | None]]()
    for problem, arm in zip(equations.tasks(), equations.unknowns.arms, strict=True):
        chi = problem.base.standard_parameters(arm.values(best.estimate))
        M = direct_model(problem.model, chi).inertia(poses_of(problem.used_positions()))
        reasons.append((problem.signals.recording, why_not_positive(M)))
    if (reason := join_reasons(reasons)) is not None:
        return f"the final estimate cannot be simulated: {reason}"
    percents = [np.inf if one.percent is None else one.percent for one in best.confirmed_by]
    if not max(percents) <= MAX_TRACKING_PERCENT:
        return "the simulated position does not follow the measured one"
    for d in direct_errors(best.confirmed_by):
        if (
            d.position_error_percent is not None
            and not d.position_error_percent <= MAX_TRACKING_PERCENT
        ):
            return (
                f"simulated joint {d.name} differs by {d.position_error_percent:.1f} % from "
                "the measured one"
            )
    return None


def tests_of(system: System, estimate: Estimate) -> InstrumentTests:
    """Tests of the instruments of an estimate."""
    indices = np.array([system.names.index(name) for name in estimate.names])
    W, _ = system.with_columns(indices).weighted(estimate.weights)
    return instrument_tests(estimate.Q, W, estimate.rows)


def direct_errors(z: Sequence[Simulated]) -> tuple[DirectModelResidual, ...]:
    """Largest errors of the simulated robot in any recording, by joint; none if one
    could not be simulated.
    """
    if any(not one.by_joint for one in z):
        return ()
    return tuple(
        DirectModelResidual(
            name=joint[0].name,
            position_error_percent=largest([d.position_error_percent for d in joint]),
            torque_error_percent=largest([d.torque_error_percent for d in joint]),
        )
        for joint in zip(*(one.by_joint for one in z), strict=True)
    )


def largest(percents: list[float | None]) -> float | None:
    """The largest that is not None: a joint may stand in one recording, or have no torque."""
    return max((x for x in percents if x is not None), default=None)


def inertia_prior(equations: Equations, ls: LeastSquares) -> Array:
    """Values of x for whose inertias the controller gains are assumed to be set: least squares
    at the rule's cut-off.

    Without that filter the inertias are poorly determined; it is left out if the
    recording is too short.
    """
    with suppress(NoFitError):
        if (behind := equations.behind_rule()) is not None:
            return least_squares(behind)[1].values_of(equations.names)
    return ls.full.values_of(equations.names)


def regular_start(model: InverseModel, base: BaseParameters, J: Array | None = None) -> Array:
    """Base parameters (b,) of a robot with only an inertia J of each motor, at its joint.

    With a coupled wrist the Ia of a joint includes all motors that turn with it: Ia5 = 2 on the
    TX40. A joint without Ia has a link with that inertia about every axis, or that mass.
    """
    chi, robot = np.zeros(model.p), model.robot
    J = np.ones(robot.n) if J is None else J
    place = {name: c for c, name in enumerate(model.names)}
    R = np.abs(robot.R) > 0
    for j, joint in enumerate(robot.joints):
        if joint.rotor_inertia:
            turning = [
                m for m in range(robot.n) if m != j and R[m, m] and R[m, j] and R[j].sum() == 1
            ]
            shares = [J[m] * (robot.R[m, j] / robot.R[m, m]) ** 2 for m in turning]
            chi[place[f"Ia{j + 1}"]] = J[j] + sum(shares)
        elif joint.type == "revolute":
            for axis in ("XX", "YY", "ZZ"):
                chi[place[f"{axis}{j + 1}"]] = J[j]
        else:
            chi[place[f"M{j + 1}"]] = J[j]
    return np.asarray(base.K @ chi)
