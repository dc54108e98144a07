"""The method on one screen: identification by the inverse dynamic model and least squares.

Letters and equation numbers are those of Janot2014: A. Janot, P.-O. Vandanjon, M. Gautier, "An instrumental variable
approach for rigid industrial robots identification", Control Engineering Practice 25 (2014) 85-101.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .base_parameters import BaseParameters, base_parameters
from .diagnostics import TorqueError, hac_sigma, lag_one, torque_errors
from .dynamics import Dynamics
from .estimators import Estimate, Reduction, essential_parameters, ordinary_least_squares, weighted_least_squares
from .plan import Overrides, Plan, make_plan
from .regression import Regression, regression_of_recording, torque_of_recording
from .signals import Signals

Vector = NDArray[np.float64]
Method = Literal["ols", "wls"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """Base parameters of a robot from one recording, and the evidence for them.

    `base` lists all base parameters; `estimate` has those estimated, which are fewer when only the essential ones were
    kept. `errors` holds one entry per joint and, last, all joints together. `sigma_hac` is NaN where the recording is so
    long that rows were reduced.
    """

    method: Method
    status: str
    plan: Plan
    base: BaseParameters
    estimate: Estimate
    essential: Reduction
    sigma_hac: Vector
    errors: tuple[TorqueError, ...]
    warnings: tuple[str, ...]

    @property
    def beta(self) -> Vector:
        """(b,) values of all base parameters, zero where one was left out."""
        return self.estimate.among(self.base.names)


def identify_ls(
    signals: Signals,
    overrides: Overrides,
    *,
    method: Method = "wls",
    essential: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> Fit:
    """IDIM-LS, section 2: base parameters beta from measured torque and filtered position.

    `essential` keeps only the parameters that the recording determines well. `say` is told what is being done. Raises
    `IdentificationError` where the recording is too short or excites too little.
    """
    plan = make_plan(signals, overrides)
    idm = Dynamics(signals.robot)
    base = base_parameters(idm)  # (2): tau = IDM(q, dq, ddq) beta
    observed = regression_of_recording(signals, plan, idm, base, say)  # (5), (6): Y(tau) = W(q, dq, ddq) beta + rho
    rows = (observed.W, observed.Y, observed.joint_of_row, observed.rows)
    full = (weighted_least_squares if method == "wls" else ordinary_least_squares)(*rows, base.names)
    rho = observed.tau - prediction(signals, plan, idm, observed, full)
    reduction = essential_parameters(*rows, full, correlation=lag_one(rho * full.weights) or 0.0)
    return judged(signals, idm, plan, observed, method, reduction.estimate if essential else full, reduction)


def prediction(signals: Signals, plan: Plan, idm: Dynamics, observed: Regression, estimate: Estimate) -> Vector:
    """Decimated torque (rows, n) that an estimate predicts for the rows of `observed`."""
    if not observed.reduced:
        among = [observed.base.names.index(name) for name in estimate.names]
        return np.asarray((observed.W[:, among] @ estimate.beta).reshape(signals.robot.n, -1).T)
    return torque_of_recording(signals, plan, idm, observed.base, estimate.among(observed.base.names))[1]


def judged(
    signals: Signals,
    idm: Dynamics,
    plan: Plan,
    observed: Regression,
    method: Method,
    estimate: Estimate,
    reduction: Reduction,
) -> Fit:
    """Set beside an estimate what speaks for and against it."""
    predicted = prediction(signals, plan, idm, observed, estimate)
    sigma_hac = np.full(len(estimate.names), np.nan)
    if not observed.reduced:
        rho = ((observed.tau - predicted) * estimate.weights).T.reshape(-1)
        sigma_hac = hac_sigma(estimate.Q, estimate.bread, rho, signals.robot.n)
    return Fit(
        method=method,
        status="solved",
        plan=plan,
        base=observed.base,
        estimate=estimate,
        essential=reduction,
        sigma_hac=sigma_hac,
        errors=torque_errors(observed.tau, predicted, observed.speed, tuple(j.name for j in signals.robot.joints)),
        warnings=(*plan.warnings, *gain_warnings(signals)),
    )


def gain_warnings(signals: Signals) -> tuple[str, ...]:
    """What a reader must know of the units where the drive gains are not given."""
    robot = signals.robot
    if robot.gain_known:
        return ()
    units = " and ".join(sorted(set(robot.effort_units)))
    text = f"the drive gains are not known: torques and parameters are in {units}, not in N m"
    shared = (
        "; joints share parameters, so the values hold only if all drives have the same gain" if robot.n > 1 else ""
    )
    return (text + shared,)


def validate(
    signals: Signals, overrides: Overrides, values: Callable[[BaseParameters], Vector]
) -> tuple[Plan, tuple[TorqueError, ...]]:
    """Torque errors that given base parameters leave on a recording; nothing is fitted.

    `values` gives the parameters (b,) in the order of the robot's base parameters.
    """
    plan = make_plan(signals, overrides)
    idm = Dynamics(signals.robot)
    base = base_parameters(idm)
    tau, predicted, speed = torque_of_recording(signals, plan, idm, base, values(base))
    return plan, torque_errors(tau, predicted, speed, tuple(j.name for j in signals.robot.joints))
