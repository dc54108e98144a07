"""Sets beside an estimate what speaks for and against it, and says whether the iteration may be called converged."""

from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..data import Signals
from ..estimation import (
    Estimate,
    InstrumentTests,
    Reduction,
    hac_sigma,
    instrument_tests,
    lag_one,
    relative_error_percent,
    torque_errors,
)
from ..model import InverseModel
from ..regression import Motion, Regression, Settings, torque_of_recording
from .fit import DirectModelError, Fit, InstrumentEvidence, Method, Pass, Status
from .plausibility import physical_doubts
from .replica import Experiment, Instruments, SimulatedMotion

TRACKED_PERCENT = 20.0  # a simulation further off the measured position does not vouch for its estimate
SATURATED_PERCENT = 1.0  # a share of saturated samples worth a warning
WEAK_INSTRUMENTS_F = 10.0


def predicted_rows(
    signals: Signals, plan: Settings, idm: InverseModel, observed: Regression, estimate: Estimate
) -> Array:
    """Decimated torque (rows, n) that an estimate predicts for the rows of `observed`."""
    if not observed.reduced:
        among = [observed.base.names.index(name) for name in estimate.names]
        return np.asarray((observed.W[:, among] @ estimate.beta).reshape(signals.robot.n, -1).T)
    return torque_of_recording(signals, plan, idm, observed.base, estimate.among(observed.base.names))[1]


def judged(
    signals: Signals,
    idm: InverseModel,
    plan: Settings,
    observed: Regression,
    method: Method,
    estimate: Estimate,
    reduction: Reduction,
    *,
    status: Status = "solved",
    used: Array | None = None,
    weighted: Estimate | None = None,
    iv: InstrumentEvidence | None = None,
    warnings: tuple[str, ...] = (),
) -> Fit:
    """A fit: the estimate with torque errors of all rows, robust deviations and warnings.

    `used` (r,) marks the rows that counted; by default those of least squares. `weighted` is weighted least squares beside an
    estimate whose rows all weigh alike, whose deviations drown what a joint of small torques says of its signs.
    """
    predicted = predicted_rows(signals, plan, idm, observed, estimate)
    used = observed.used if used is None else used
    sigma_hac = _robust_sigma(observed, estimate, predicted, used)
    doubts = physical_doubts(signals, plan, idm, observed.base, estimate, sigma_hac)
    if weighted is not None and not any(doubt.severe for doubt in doubts):
        hac = _robust_sigma(observed, weighted, predicted_rows(signals, plan, idm, observed, weighted), used)
        found = physical_doubts(signals, plan, idm, observed.base, weighted, hac)
        doubts = tuple(replace(d, text=f"by weighted least squares {d.text}") for d in found if d.severe) or doubts
    return Fit(
        method=method,
        status=status,
        settings=plan,
        base=observed.base,
        estimate=estimate,
        essential=reduction,
        sigma_hac=sigma_hac,
        errors=torque_errors(observed.tau, predicted, observed.speed, tuple(j.name for j in signals.robot.joints)),
        warnings=(
            *(doubt.text for doubt in doubts),
            *plan.warnings,
            *gain_warnings(signals),
            *recording_warnings(signals),
            *warnings,
        ),
        doubts=doubts,
        iv=iv,
    )


def _robust_sigma(observed: Regression, estimate: Estimate, predicted: Array, used: Array) -> Array:
    """HAC deviations (b,) from the rows that are `used` (r,); NaN where rows are reduced."""
    if observed.reduced:
        return np.full(len(estimate.names), np.nan)
    rho = ((observed.tau - predicted) * estimate.weights).T.reshape(-1)
    return hac_sigma(estimate.Q, estimate.bread, rho * used, observed.tau.shape[1], rows=estimate.rows)


@np.errstate(over="ignore", invalid="ignore")  # a start may be anything
def compared(
    estimate: Estimate,
    z: Instruments,
    before: Array,
    observed: Regression,
    used: Array,
    tolerance_percent: float,
) -> Pass:
    """A pass that led from the parameters simulated to `estimate`, and whether it settled.

    Where the robot was simulated with other parameters than those asked for, the estimate is compared with the one `before`
    (b,). Both must hold: the residual norm changed by less than the tolerance, and each parameter by less than the tolerance or
    half its deviation, whichever is larger. Parameters near zero never settle in percent of themselves. Both norms are of
    the rows that this pass used.
    """
    tolerance = 0.01 * tolerance_percent
    start = before if z.kind == "stepped back" else z.beta
    old = np.array([start[observed.base.names.index(name)] for name in estimate.names])
    change = np.abs(estimate.beta - old)
    w = estimate.weights[observed.joint_of_row] * used
    norm_before = float(np.linalg.norm(w * (observed.Y - observed.W @ start)))
    norm_change = abs(estimate.residual_norm - norm_before)
    with np.errstate(divide="ignore", invalid="ignore"):
        in_sigma = np.where(change > 0, change / estimate.sigma, 0.0)
        in_percent = np.where(np.abs(estimate.beta) > 2 * estimate.sigma, 100 * change / np.abs(estimate.beta), 0.0)
    return Pass(
        instruments=z.kind,
        reason=z.reason,
        residual_norm=estimate.residual_norm,
        change_sigma=float(in_sigma.max()),
        change_percent=float(in_percent.max()),
        changed=estimate.names[int(in_sigma.argmax())],
        gains=z.gains,
        tracking_percent=z.tracking_percent,
        condition=estimate.condition_number_scaled,
        residual_percent=100 * norm_change / norm_before if norm_before > 0 else 0.0,
        residual_settled=norm_change <= tolerance * norm_before,
        parameters_settled=bool((change <= np.maximum(tolerance * np.abs(estimate.beta), estimate.sigma / 2)).all()),
    )


def judged_iv(
    signals: Signals,
    idm: InverseModel,
    plan: Settings,
    observed: Regression,
    estimate: Estimate,
    reduction: Reduction,
    e: Experiment,
    final: SimulatedMotion,
    passes: tuple[Pass, ...],
    returned: int,
    used: Array,
    start: str,
    failure: str | None,
) -> Fit:
    """A fit by instruments: that of pass `returned`; `final` is the robot simulated with it: the direct model's validation."""
    w = estimate.weights[observed.joint_of_row] * used
    among = [observed.base.names.index(name) for name in estimate.names]
    W, Y = observed.W[:, among] * w[:, None], observed.Y * w
    rho = (Y - W @ estimate.beta).reshape(signals.robot.n, -1).T
    tests = instrument_tests(estimate.Q, W, Y, estimate.rows, lag_one(rho) or 0.0)
    direct: list[DirectModelError] = []
    if final.motion is not None:
        tau = e.decimation.filtered(final.motion.tau.T).T
        tracking = joint_tracking_percent(e, final.motion)
        for j, joint in enumerate(signals.robot.joints):
            direct.append(
                DirectModelError(
                    name=joint.name,
                    position_error_percent=tracking[j],
                    torque_error_percent=relative_error_percent(observed.tau[:, j], observed.tau[:, j] - tau[:, j]),
                )
            )
    status, reason = _verdict(passes, final.reason, final.tracking_percent, failure, direct, tests)
    if reason is not None and returned != len(passes):
        reason += f"; pass {returned} is returned, which tracks best"
    evidence = InstrumentEvidence(
        start=start,
        reference=e.reference,
        controller="surrogate" if e.loop is None else "described",
        passes=passes,
        returned=returned,
        reason=reason,
        tests=tests,
        rows_used_percent=float(100 * used.mean()),
        saturated_percent=e.saturated_percent,
        direct=tuple(direct),
        simulated=final.motion,
        q=e.q,
    )
    return judged(
        signals,
        idm,
        plan,
        observed,
        "iv",
        estimate,
        reduction,
        status=status,
        used=used,
        iv=evidence,
        warnings=_iv_warnings(e, tests),
    )


def _verdict(
    passes: tuple[Pass, ...],
    final_reason: str | None,
    tracking_percent: float | None,
    failure: str | None,
    direct: list[DirectModelError],
    tests: InstrumentTests,
) -> tuple[Status, str | None]:
    """`converged` is only said of an estimate that settled, along simulated instruments that explain W, and that tracks.

    One that settled otherwise is `not_confirmed`. Every joint has to track, not the robot on average: a joint of small travel
    would hide behind the others.
    """
    if failure is not None:
        return "diverged", failure
    if not tests.first_stage_F >= 1.0:
        return "diverged", f"the instruments do not explain the regressor: first-stage F = {tests.first_stage_F:.2g}"
    last, unconfirmed = passes[-1], _unconfirmed(final_reason, tracking_percent, direct)
    if last.settled:
        if unconfirmed is None and last.instruments != "simulated":
            unconfirmed = f"settled without simulated instruments: {last.reason}"
        return ("converged", None) if unconfirmed is None else ("not_confirmed", unconfirmed)
    if unconfirmed is not None:
        return "diverged", unconfirmed
    moving = []
    if not last.parameters_settled:
        moving.append(f"{last.changed} still changes by {last.change_sigma:.2g} sigma")
    if not last.residual_settled:
        moving.append(f"the residual norm still changes by {last.residual_percent:.2g} %")
    return "max_iterations", f"after {len(passes)} passes " + " and ".join(moving)


def _unconfirmed(
    final_reason: str | None, tracking_percent: float | None, direct: list[DirectModelError]
) -> str | None:
    """Why the robot simulated with the final estimate does not vouch for it, or None where it does."""
    if final_reason is not None:
        return f"the final estimate cannot be simulated: {final_reason}"
    if tracking_percent is None or not tracking_percent <= TRACKED_PERCENT:
        return "the simulated position does not follow the measured one"
    for d in direct:
        if d.position_error_percent is not None and not d.position_error_percent <= TRACKED_PERCENT:
            return f"simulated joint {d.name} is {d.position_error_percent:.1f} % off the measured one"
    return None


def joint_tracking_percent(e: Experiment, simulated: Motion) -> list[float | None]:
    """How far each simulated joint is off the measured one, in percent of its variation; None for one that stands."""
    return [relative_error_percent(q - q.mean(), off) for q, off in zip(e.q.T, (simulated.q - e.q).T, strict=True)]


def _iv_warnings(e: Experiment, tests: InstrumentTests) -> tuple[str, ...]:
    warnings = []
    if e.reference == "surrogate":
        warnings.append(
            "surrogate reference: the recording has none, the measured position stands in; the instruments are not "
            "strictly exogenous"
        )
    if e.loop is None:
        warnings.append(f"surrogate controller: none is described, a PD of {e.bandwidth_hz:g} Hz stands in")
    if not e.J_known and e.loop is not None:
        warnings.append(
            "least squares gives no positive inertias: those that the described gains suit at "
            f"{e.bandwidth_hz:g} Hz stand in for the gain update"
        )
    if e.saturated_percent is not None and e.saturated_percent > SATURATED_PERCENT:
        warnings.append(f"a drive is saturated in {e.saturated_percent:.1f} % of the samples")
    if tests.first_stage_F < WEAK_INSTRUMENTS_F:
        warnings.append(f"weak instruments: first-stage F = {tests.first_stage_F:.2g}, below {WEAK_INSTRUMENTS_F:g}")
    return tuple(warnings)


def recording_warnings(signals: Signals) -> tuple[str, ...]:
    """What the recorder warned of, such as SYNC at another period than described: estimates rest on it."""
    return tuple(f"recording: {event.text}" for event in signals.events if event.kind == "warning")


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
