"""The iterations of the instrumental variable method.

The module computes the values simulated first and next, makes one iteration, and chooses the
iteration that is returned.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..errors import BadInputError, NoFitError
from ..estimation import (
    Estimate,
    covariance_of_all,
    first_stage,
    instrumental_variables,
    intervals_of,
    weighted_least_squares,
)
from ..model import BaseParameters, InverseModel
from ..regression import Lag, Rows, lags_in
from ..report import Status, is_base
from ..simulation import Simulated
from .model import Asked, Model
from .passes import Pass, join_reasons
from .start import solution_of

# Samples: equation (G) is of first order, so a larger last change of the delay is not exact.
MAX_LAST_LAG = 0.25
# From this iteration on, values and delays are the mean of the last two, which damps oscillation.
MAX_FULL_STEPS = 4
MIN_F = 1.0  # first-stage F: instruments below it do not explain W


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """Settings of the iterations of the instrumental variable method.

    Attributes:
        start: initial parameters: `ls` (least squares), `regular` (unit inertias, which give a
            regular inertia matrix), or the name of the source of `values`.
        tolerance_percent: largest change at convergence, percent; None for the key of robot.toml.
        max_iterations: largest number of iterations; None for the key of robot.toml.
        values: function that returns the initial base parameters, shape (b,).
        inertias: inertias of `regular`, shape (n,), kg m² or kg; None for ones.
        gain_update: True to adapt the controller gains to each estimate, equation (E).
    """

    start: str = "ls"
    tolerance_percent: float | None = None
    max_iterations: int | None = None
    values: Callable[[BaseParameters], Array] | None = None
    inertias: Array | None = None
    gain_update: bool = True

    def __post_init__(self) -> None:
        if self.inertias is not None and self.start != "regular":
            raise BadInputError(
                key="start", value=self.start, expected="regular if inertias are given"
            )


class Loop:
    """The prepared iterations of a fit, which start from a solution by least squares.

    Attributes:
        model: recordings and unknowns.
        start: least squares, whose weights all iterations use.
        x: (p,) values of least squares.
        ls: least squares of the fitted parameters: `start`, or only the essential ones.
        essential: test that finds the essential parameters.
        iteration: settings of the iterations.
        robots: recordings prepared for simulations.
        measured: speeds and largest torques of all recordings.
        fitted: places of the estimated unknowns in x.
        most: limit of the number of iterations.
        tolerance_percent: largest change that counts as converged.
    """

    def __init__(self, model: Model, start: Pass, iteration: Iteration, *, essential: bool) -> None:
        """Prepare the iterations; `essential` restricts them to the essential parameters."""
        self.model, self.iteration = model, iteration
        self.measured = start.kept.speed, start.kept.most
        start, ls, self.essential = solution_of(model, start, essential=essential)
        self.start, self.ls = start.without_rows(), ls.without_rows()
        self.x = model.x_of(start.estimate, start.x)
        stored, names = model.problem.signals.robot.identification, model.names
        self.most = iteration.max_iterations or stored.max_iterations
        self.tolerance_percent = iteration.tolerance_percent or stored.tolerance_percent
        self.robots = model.robots(inertia_prior(model, self.x), gain_update=iteration.gain_update)
        of = self.essential.names if essential else names
        self.fitted = np.flatnonzero([name in of or not is_base(name) for name in names])

    def step(self, rows: Rows) -> Estimate:
        """Estimate the free unknowns from rows about x, with instruments along a simulated motion.

            x + (Z'J)⁻¹ Z'r(x),     of linear terms beta = (Z'W)⁻¹ Z'Y                   (C), (D)

        The rows have the weights of least squares. Raises `NoFitError` as `instrumental_variables`.
        """
        system = rows.system.with_columns(self.fitted)
        Z = rows.Z if len(self.fitted) == len(self.model.names) else rows.Z[:, self.fitted]
        return self.model.combined(
            system, instrumental_variables(system, Z, self.start.estimate.weights)
        )

    @np.errstate(over="ignore", invalid="ignore")  # a start may be anything
    def next_pass(self, before: Sequence[Pass], x: Array, asked: Asked | None) -> Pass:
        """Make one iteration: simulate, find the delay, estimate, and compare with the last values.

            Z = F[w IDM(q_s, dq_s, ddq_s)],     x_k+1 = x_k + (Z'J)⁻¹ Z'r(x_k)           (D), (C)

        Parameters
        ----------
        before : the iterations so far, beginning with least squares.
        x : (p,) values x_k at which the rows are linearised.
        asked : values (p,) to simulate and their covariance (f, f), or None to simulate exactly
            these values. None in place of both for the motion that the reference predicts.

        Returns
        -------
        The iteration. It has converged if the residual norm changes by at most the tolerance, and
        each parameter by at most the tolerance or half its standard error.

        Raises
        ------
        NoFitError : these instruments give no estimate; the text says why they are not those of the
            requested robot.
        """
        number, other = len(before), asked is not None and asked[0] is not x
        of_lag = self.model.exogenous and not other
        # While a delay is estimated the first iteration is never the last, so it needs no tests.
        tests = not of_lag or number > 1 or all(lag.stated for lag in before[-1].lags)
        z, rows = self.model.with_instruments(  # q_s, dq_s, ddq_s, with (E), and (6)
            self.robots, x, asked, self.measured if tests else None, of_lag=of_lag
        )
        rows, lags, settled = with_lags_found(rows, before[-1].lags, number)  # (G)
        try:
            estimate = self.step(rows)  # (C), (D)
        except NoFitError as error:
            reason = join_reasons([(one.recording, one.reason) for one in z])
            raise NoFitError("; ".join(filter(None, [str(error), reason]))) from error
        # Compare with the requested values, not with the physically consistent ones simulated in
        # their place. A parameter near zero never converges in percent, so half a standard error is
        # enough.
        tolerance, system = 0.01 * self.tolerance_percent, rows.system
        change, w = np.abs(estimate.beta - x[self.fitted]), estimate.weights[system.joint_of_row]
        norm_before = float(np.linalg.norm(w * (system.Y - system.W @ x[: len(system.names)])))
        norm_change, size = abs(estimate.residual_norm - norm_before), np.abs(estimate.beta)
        with np.errstate(divide="ignore"):
            in_sigma = np.where(change > 0, change / estimate.sigma, 0.0)
            in_percent = np.where(size > 2 * estimate.sigma, 100 * change / size, 0.0)
        norm_percent = 100 * norm_change / norm_before if norm_before > 0 else 0.0
        return Pass(
            x=rows.x,
            z=z,
            rows=rows,
            estimate=estimate,
            intervals=intervals_of(rows.system, estimate),
            lags=lags,
            is_consistent=settled and not other,
            change_in_sigma=in_sigma,
            change_percent=float(in_percent.max()),
            residual_change_percent=(
                None if norm_change <= tolerance * norm_before else norm_percent
            ),
            parameters_settled=bool(
                (change <= np.maximum(tolerance * size, estimate.sigma / 2)).all()
            ),
            number=number,
        )

    def covariance(self, one: Pass) -> Array:
        """Return C = D R D (f, f) of an iteration.

        The parameters that it did not estimate have the covariance of least squares.
        """
        return covariance_of_all(self.model.names, one.estimate, one.intervals, self.start.estimate)


def start_values(loop: Loop) -> Asked:
    """Return the values (p,) that are simulated first, and their covariance (f, f).

    They are x of least squares, or given values, or a regular start, whose covariance is None.
    Given values and a regular start do not predict the torque well enough to find a delay with it.
    """
    problem, how, repeated = loop.model.problem, loop.iteration, loop.model.unknowns.repeated
    if how.start == "regular":
        return repeated(loop.x, regular_start(problem.model, problem.base, how.inertias)), None
    x = loop.x if how.values is None else repeated(loop.x, how.values(problem.base))
    return x, loop.covariance(loop.start)


def next_values(loop: Loop, passes: Sequence[Pass]) -> tuple[Array, Asked]:
    """Return x (p,) for the rows of the next iteration, and the values that it simulates.

    Both are the estimate x_k+1; from the fourth iteration on, its mean with x_k, which damps
    oscillation. After least squares the start is simulated.
    """
    last = passes[-1]
    if last.number == 0:
        return loop.x, start_values(loop)
    x = loop.model.x_of(last.estimate, last.x)
    x = 0.5 * (x + last.x) if last.number >= MAX_FULL_STEPS else x
    return x, (x, loop.covariance(last))


def with_lags_found(
    rows: Rows, lags: Sequence[Lag], number: int
) -> tuple[Rows, tuple[Lag, ...], bool]:
    """Find the delay L of each group of recordings from the rows of the delay and prior knowledge.

        tau(t - L) = tau(t) - L dtau/dt                                                  (G)

    Parameters
    ----------
    rows : [C Z J r] about the last delays, with rows of the delay. Without these, nothing changes.
    lags : delays so far, with the prior knowledge of each.
    number : of the iteration. The first one whitens the rows of the delay by the residuals of least
        squares, which contain the delay; its delays have therefore not converged unless they are
        given. From the fourth iteration on a delay takes half its step, as values do.

    Returns
    -------
    The rows about the new delays, to first order; these delays, s; and True if they have converged:
    the whole step of each is less than a quarter of a sample.
    """
    if rows.late is None:
        return rows, tuple(lags), True
    before = rows.x[-len(lags) :]
    lags = lags_in(rows.late, before, lags)
    values = np.array([lag.value_s for lag in lags])
    small = np.abs(values - before) < MAX_LAST_LAG * np.array([lag.period_s for lag in lags])
    values = 0.5 * (values + before) if number >= MAX_FULL_STEPS else values
    lags = tuple(replace(lag, value_s=s) for lag, s in zip(lags, values.tolist(), strict=True))
    settled = bool(small.all()) and (number > 1 or all(lag.stated for lag in lags))
    return rows.linearised_at(np.r_[rows.x[: -len(lags)], values]), lags, settled


def conclude(loop: Loop, passes: Sequence[Pass]) -> tuple[Pass, tuple[Simulated, ...]]:
    """Choose the iteration that is returned.

    It is the last one if that converged. Else it is the iteration whose simulated estimate tracks
    best, by its worst joint.

    Parameters
    ----------
    loop : the prepared iterations.
    passes : iterations in order, beginning with least squares; all but the last without rows.

    Returns
    -------
    The chosen iteration with its rows, about the last delays; and by recording the robot simulated
    with its estimate, or with the values at which it converged.

    Raises
    ------
    NoFitError : the rows are computed again and give no estimate, as in `Loop.step`.
    """
    last, model = passes[-1], loop.model
    if last.is_last:
        return last, last.z

    def confirmed(one: Pass) -> tuple[Simulated, ...]:
        x = model.x_of(one.estimate, last.x)
        return model.with_instruments(loop.robots, x, (x, loop.covariance(one)))[0]

    after = confirmed(last)
    tracked = [_tracking(one.z) for one in passes[2:]] + [_tracking(after)]
    best = passes[int(np.argmin(tracked)) + 1 if min(tracked) < np.inf else -1]
    if best is last and last.rows is not None and last.rows.C.size:
        return last, after
    x = np.r_[best.x[: len(model.names)], last.x[len(model.names) :]]
    _, asked = next_values(loop, passes[: best.number])
    z, rows = model.with_instruments(loop.robots, x, asked, loop.measured)
    found = replace(best, x=x, z=z, rows=rows, estimate=loop.step(rows), lags=last.lags)
    return found, after if best is last else confirmed(found)


def by_reference(loop: Loop, best: Pass, ended: tuple[Status, str | None]) -> Pass | None:
    """Return an iteration with instruments from the reference, or None if they do not suffice.

    They take the place of the `best` simulated ones if those ended without confirmation, all
    references are recorded and no control law is given. `ended` is the status and its reason.
    """
    (status, why), described = ended, any(one.controller == "described" for one in best.z)
    if status == "converged" or described or not loop.model.exogenous:
        return None
    why = f"with a simulated robot, whose control law is not given, {status}: {why}"
    passes = [loop.start]
    with suppress(NoFitError):
        # The first iteration finds the delay with residuals that contain it, so a second is needed.
        for _ in range(2):
            passes.append(loop.next_pass(passes, next_values(loop, passes)[0], None))
        last = replace(passes[-1], by_reference=why)
        return last if tests_of(last)[1] >= MIN_F else None
    return None


def _tracking(z: Sequence[Simulated]) -> float:
    """Return the position error of the worst joint, percent.

    It is infinite if the estimate itself was not simulated.
    """
    return (
        np.inf
        if any(one.kind != "simulated" for one in z)
        else max(joint.position_error_percent or 0.0 for one in z for joint in one.by_joint)
    )


def tests_of(one: Pass) -> tuple[float, float]:
    """Return strength and first-stage F of the instruments of an iteration."""
    system, estimate = one.kept.system, one.estimate
    places = [system.names.index(name) for name in estimate.names]
    W, _ = system.with_columns(np.array(places)).weighted(estimate.weights)
    return first_stage(estimate.Q, W, estimate.rows)


def inertia_prior(model: Model, x: Array) -> Array:
    """Return x (p,) whose inertias are the a priori inertias of equation (E).

    The controller gains are assumed to be set for them. They follow from least squares after a
    low-pass, because their estimates are poor without one. A fit without low-pass uses that of
    torque errors.
    """
    # The low-pass of errors may leave too few rows: then x itself has to do.
    with suppress(NoFitError):
        if not all(problem.settings.filtered for problem in model.problems):
            rows = (behind := model.for_errors).rows(x).of(behind.unknowns.arm)
            return behind.x_of(behind.combined(rows, weighted_least_squares(rows)), x)
    return x


def regular_start(model: InverseModel, base: BaseParameters, J: Array | None = None) -> Array:
    """Return base parameters beta = K chi (b,) of a robot with only an inertia of each motor.

    With a coupled wrist the Ia of a joint includes all motors that turn with it: Ia5 = 2 on the
    TX40. A joint without Ia gets a link with that inertia about every axis, or with that mass.

    Parameters
    ----------
    model : the robot with its p standard parameters.
    base : base parameters, which regroup them.
    J : (n,) inertias of the motors at their joints, kg m² or kg; ones by default.
    """
    robot, R, chi = model.robot, np.abs(model.robot.R) > 0, dict[str, float]()
    J = np.ones(robot.n) if J is None else J
    for j, joint in enumerate(robot.joints):
        if joint.rotor_inertia:
            chi[f"Ia{j + 1}"] = J[j] + sum(
                J[m] * (robot.R[m, j] / robot.R[m, m]) ** 2
                for m in range(robot.n)
                if m != j and R[m, m] and R[m, j] and R[j].sum() == 1
            )
        elif joint.type == "revolute":
            chi |= dict.fromkeys((f"XX{j + 1}", f"YY{j + 1}", f"ZZ{j + 1}"), J[j])
        else:
            chi[f"M{j + 1}"] = J[j]
    return np.asarray(base.K @ [chi.get(name, 0.0) for name in model.names])
