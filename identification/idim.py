"""The method on one screen: identification by the inverse dynamic model, with least squares or instrumental variables.

Letters and equation numbers are those of Janot2014: A. Janot, P.-O. Vandanjon, M. Gautier, "An instrumental variable
approach for rigid industrial robots identification", Control Engineering Practice 25 (2014) 85-101.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from . import IdentificationError
from .base_parameters import BaseParameters, base_parameters
from .diagnostics import TorqueError, lag_one, torque_errors
from .dynamics import Dynamics
from .estimators import (
    essential_parameters,
    instrumental_variables,
    one_thread,
    ordinary_least_squares,
    weighted_least_squares,
)
from .fit import Fit, Pass
from .instruments import experiment, fast_rows, instruments, regular_start, simulated_motion
from .judgement import compared, judged, judged_iv, predicted_rows
from .plan import Overrides, Plan, make_plan, rule_cutoff_hz
from .regression import regression_of_recording, torque_of_recording
from .signals import Signals

Vector = NDArray[np.float64]
Say = Callable[[str], None]


ROWS_FREE = 3  # passes that choose their own rows; later ones keep them, or rows at the threshold come and go for ever

RELAXED_AFTER = 4  # passes; later ones simulate the mean of the last two, which ends going to and fro


def _silent(text: str) -> None:
    pass


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """How the instrumental variable method iterates.

    `start`: `regular` (an inertia matrix that is regular, nothing else known), `ls`, or base parameters from `values`
    under the name they were read from. `low_speed_percent`: rows slower than this, in percent of the simulated peak speed,
    are left out; None takes 4 %, or 4 deviations of the measured speed's noise where that is more.
    """

    start: str = "regular"
    values: Callable[[BaseParameters], Vector] | None = None
    tolerance_percent: float = 2.5
    max_iterations: int = 10
    gain_update: bool = True
    low_speed_percent: float | None = None


@one_thread
def identify_ls(
    signals: Signals,
    overrides: Overrides,
    *,
    method: Literal["ols", "wls"] = "wls",
    essential: bool = False,
    say: Say = _silent,
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
    rho = observed.tau - predicted_rows(signals, plan, idm, observed, full)
    reduction = essential_parameters(*rows, full, correlation=lag_one(rho * full.weights) or 0.0)
    return judged(signals, idm, plan, observed, method, reduction.estimate if essential else full, reduction)


@one_thread
def identify_iv(
    signals: Signals,
    overrides: Overrides,
    iteration: Iteration,
    *,
    essential: bool = False,
    say: Say = _silent,
) -> Fit:
    """IDIM-IV, section 3: the instruments Z are the model along the robot simulated with the estimate before.

    W and Y are those of IDIM-LS. Each pass simulates the closed loop with beta_k (same reference, same controller, gains
    updated by beta_k), evaluates Z = IDM of the simulated q, dq, ddq, decimated as W, and solves for beta_k+1.
    """
    plan = make_plan(signals, overrides)
    idm = Dynamics(signals.robot)
    base = base_parameters(idm)  # (2)
    observed = regression_of_recording(signals, plan, idm, base, say)  # (5), (6)
    if observed.reduced:
        raise IdentificationError(f"{signals.recording}: too long for instruments; expected a larger --decimate")
    W, Y, joint_of_row, names = observed.W, observed.Y, observed.joint_of_row, base.names
    ls = weighted_least_squares(W, Y, joint_of_row, observed.rows, names)
    rho = observed.tau - predicted_rows(signals, plan, idm, observed, ls)
    reduction = essential_parameters(
        W, Y, joint_of_row, observed.rows, ls, correlation=lag_one(rho * ls.weights) or 0.0
    )
    kept = reduction.kept if essential else np.arange(base.b)
    e = experiment(signals, plan, idm, base, _prior(signals, overrides, plan, ls.beta))
    beta = ls.beta if iteration.start == "ls" else regular_start(idm, base)
    if iteration.values is not None:
        beta = iteration.values(base)
    passes: list[Pass] = []
    estimate, used = ls, np.ones(len(Y))
    good: Vector | None = None
    failure: str | None = None
    while not (passes and passes[-1].settled) and len(passes) < iteration.max_iterations:
        say(f"pass {len(passes) + 1}: simulating the robot")
        z = instruments(e, beta, good, gain_update=iteration.gain_update)  # Z = IDM(q_sim, dq_sim, ddq_sim)
        good = good if z.kind == "reference" else z.beta
        if len(passes) < ROWS_FREE:
            used = fast_rows(e, z, iteration.low_speed_percent)
        try:
            estimate = instrumental_variables(  # beta = (ZᵀW)⁻¹ ZᵀY
                z.Z[:, kept], W[:, kept], Y, joint_of_row, tuple(names[i] for i in kept), ls.weights, used
            )
        except IdentificationError as error:
            failure = f"pass {len(passes) + 1}, {100 * used.mean():.0f} % of the rows fast enough: {error}"
            failure += f"; {z.reason}" if z.reason else ""
            break
        passes.append(compared(estimate, z, observed, used, iteration.tolerance_percent))
        beta = estimate.among(names)
        if len(passes) >= RELAXED_AFTER:
            beta = 0.5 * (beta + z.beta)
    if not passes:
        raise IdentificationError(f"{signals.recording}: no instruments: {failure}")
    final = simulated_motion(e, estimate.among(names), gain_update=iteration.gain_update)
    return judged_iv(
        signals, idm, plan, observed, estimate, reduction, e, final, tuple(passes), used, iteration.start, failure
    )


def _prior(signals: Signals, overrides: Overrides, plan: Plan, beta_ls: Vector) -> Vector:
    """Parameters (b,) whose inertias the controller's gains are taken to be set for: least squares at the rule's cut-off.

    Without that filter least squares says little of the inertias; it is taken where the recording is too short to filter.
    """
    if not plan.smooth_ends:
        return beta_ls
    cutoff_hz = rule_cutoff_hz(signals.robot.controller.bandwidth_hz, signals.sample_rate_hz)
    try:
        return identify_ls(signals, replace(overrides, cutoff_hz=cutoff_hz, decimation=plan.decimation)).beta
    except IdentificationError:
        return beta_ls


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
