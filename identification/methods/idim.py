"""The method on one screen: identification by the inverse dynamic model, with least squares or instrumental variables.

Letters and equation numbers are those of Janot2014: A. Janot, P.-O. Vandanjon, M. Gautier, "An instrumental variable
approach for rigid industrial robots identification", Control Engineering Practice 25 (2014) 85-101.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..arrays import Array
from ..data import Signals
from ..errors import IdentificationError
from ..estimation import (
    Estimate,
    Reduction,
    TorqueError,
    essential_parameters,
    instrumental_variables,
    lag_one,
    one_thread,
    ordinary_least_squares,
    torque_errors,
    weighted_least_squares,
)
from ..model import BaseParameters, InverseModel, base_parameters
from ..regression import (
    Overrides,
    Regression,
    Settings,
    fast_rows,
    make_settings,
    regression_of_recording,
    rule_cutoff_hz,
    torque_of_recording,
)
from .assess import compared, joint_tracking_percent, judged, judged_iv, predicted_rows
from .fit import Fit, Pass
from .replica import Experiment, Instruments, SimulatedMotion, experiment, instruments, regular_start, simulated_motion

Say = Callable[[str], None]


ROWS_FREE = 3  # passes that choose their own rows; later ones keep them, or rows at the threshold come and go for ever

RELAXED_AFTER = 4  # passes; later ones simulate the mean of the last two, which ends going to and fro


def _silent(text: str) -> None:
    pass


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """How the instrumental variable method iterates.

    `start`: `regular` (an inertia matrix that is regular, nothing else known), `ls`, or base parameters from `values`
    under the name they were read from.
    """

    start: str = "regular"
    values: Callable[[BaseParameters], Array] | None = None
    tolerance_percent: float = 2.5
    max_iterations: int = 10
    gain_update: bool = True


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
    plan = make_settings(signals, overrides)
    idm = InverseModel(signals.robot)
    base = base_parameters(idm)  # (2): tau = IDM(q, dq, ddq) beta
    observed = regression_of_recording(signals, plan, idm, base, say)  # (5), (6): Y(tau) = W(q, dq, ddq) beta + rho
    weighted = weighted_least_squares(*observed.counted, base.names)
    full = weighted if method == "wls" else ordinary_least_squares(*observed.counted, base.names)
    reduction = _reduced(signals, plan, idm, observed, full)
    estimate, beside = reduction.estimate if essential else full, None if method == "wls" else weighted
    return judged(signals, idm, plan, observed, method, estimate, reduction, weighted=beside)


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
    plan = make_settings(signals, overrides)
    idm = InverseModel(signals.robot)
    base = base_parameters(idm)  # (2)
    observed = regression_of_recording(signals, plan, idm, base, say)  # (5), (6)
    if observed.reduced:
        raise IdentificationError(f"{signals.recording}: too long for instruments; expected a larger --decimate")
    W, Y, joint_of_row, names = observed.W, observed.Y, observed.joint_of_row, base.names
    ls = weighted_least_squares(*observed.counted, names)
    reduction = _reduced(signals, plan, idm, observed, ls)
    kept = reduction.kept if essential else np.arange(base.b)
    e = experiment(signals, plan, idm, base, _prior(signals, overrides, plan, ls.beta))
    beta = ls.beta if iteration.start == "ls" else regular_start(idm, base)
    if iteration.values is not None:
        beta = iteration.values(base)

    def solved(z: Instruments, rows: Array) -> Estimate:  # beta = (ZᵀW)⁻¹ ZᵀY
        few = tuple(names[i] for i in kept)
        return instrumental_variables(z.Z[:, kept], W[:, kept], Y, joint_of_row, few, ls.weights, rows)

    passes: list[Pass] = []
    tried: list[Instruments] = []
    estimate, used, before = ls, np.ones(len(Y)), beta
    good: Array | None = None
    failure: str | None = None
    while not (passes and passes[-1].settled) and len(passes) < iteration.max_iterations:
        say(f"pass {len(passes) + 1}: simulating the robot")
        z = instruments(e, beta, good, gain_update=iteration.gain_update)  # Z = IDM(q_sim, dq_sim, ddq_sim)
        good = good if z.kind == "reference" else z.beta
        rows = used
        if len(passes) < ROWS_FREE:
            rows = fast_rows(z.slip, e.slip_noise, e.directions, plan.low_speed.iv).T.reshape(-1).astype(float)
        try:
            estimate = solved(z, rows)
        except IdentificationError as error:
            failure = f"pass {len(passes) + 1}, {100 * rows.mean():.0f} % of the rows fast enough: {error}"
            failure += f"; {z.reason}" if z.reason else ""
            break
        used = rows
        tried.append(z)
        passes.append(compared(estimate, z, before, observed, used, iteration.tolerance_percent))
        beta = before = estimate.among(names)
        if len(passes) >= RELAXED_AFTER:
            beta = 0.5 * (beta + z.beta)
    if not passes:
        raise IdentificationError(f"{signals.recording}: no instruments: {failure}")
    final, returned = simulated_motion(e, before, gain_update=iteration.gain_update), len(passes)
    if not passes[-1].settled or failure is not None:
        best = _best_pass(e, _solvable(solved, tried, used), names, gain_update=iteration.gain_update)
        if best is not None:
            returned, estimate, final = best
    return judged_iv(
        signals,
        idm,
        plan,
        observed,
        estimate,
        reduction,
        e,
        final,
        tuple(passes),
        returned,
        used,
        iteration.start,
        failure,
    )


def _reduced(signals: Signals, plan: Settings, idm: InverseModel, observed: Regression, full: Estimate) -> Reduction:
    """The essential parameters, by least squares on the rows that count."""
    rho = (observed.tau - predicted_rows(signals, plan, idm, observed, full)) * full.weights * observed.fast
    return essential_parameters(*observed.counted, full, correlation=lag_one(rho) or 0.0)


def _solvable(
    solved: Callable[[Instruments, Array], Estimate], tried: list[Instruments], used: Array
) -> dict[int, Estimate]:
    """The passes' estimates on the same rows, by number, counted from 1; without those that these rows do not determine."""
    found = {}
    for number, z in enumerate(tried, 1):
        with suppress(IdentificationError):
            found[number] = solved(z, used)
    return found


def _best_pass(
    e: Experiment, estimates: dict[int, Estimate], names: tuple[str, ...], *, gain_update: bool
) -> tuple[int, Estimate, SimulatedMotion] | None:
    """Where there is no fixed point, the pass whose simulated robot tracks best at its worst joint.

    `estimates` are those of the passes by number, all on the rows of the last. None where no robot can be simulated with any
    of them.
    """
    found = []
    for number, estimate in estimates.items():
        simulated = simulated_motion(e, estimate.among(names), gain_update=gain_update)
        if simulated.motion is not None:
            worst = max((x for x in joint_tracking_percent(e, simulated.motion) if x is not None), default=0.0)
            found.append((worst, number, estimate, simulated))
    return min(found, key=lambda one: one[0])[1:] if found else None


def _prior(signals: Signals, overrides: Overrides, plan: Settings, beta_ls: Array) -> Array:
    """Parameters (b,) whose inertias the controller's gains are taken to be set for: least squares at the rule's cut-off.

    Without that filter least squares says little of the inertias; it is taken where the recording is too short to filter.
    """
    if plan.filtered:
        return beta_ls
    cutoff_hz = rule_cutoff_hz(signals.robot.controller.bandwidth_hz, signals.sample_rate_hz)
    try:
        return identify_ls(signals, replace(overrides, cutoff_hz=cutoff_hz, decimation=plan.decimation)).beta
    except IdentificationError:
        return beta_ls


def validate(
    signals: Signals, overrides: Overrides, values: Callable[[BaseParameters], Array]
) -> tuple[Settings, tuple[TorqueError, ...]]:
    """Torque errors that given base parameters leave on a recording; nothing is fitted.

    `values` gives the parameters (b,) in the order of the robot's base parameters.
    """
    plan = make_settings(signals, overrides)
    idm = InverseModel(signals.robot)
    base = base_parameters(idm)
    tau, predicted, speed = torque_of_recording(signals, plan, idm, base, values(base))
    return plan, torque_errors(tau, predicted, speed, tuple(j.name for j in signals.robot.joints))
