"""How the passes of instrumental variables ended, and whether the simulated robot confirms the
estimate.
"""

from collections.abc import Sequence

import numpy as np

from ..estimation import first_stage
from ..model import direct_model, poses_of, why_not_positive
from ..report import DirectModelResidual, Status
from ..simulation import Simulated
from .fit import Pass, join_reasons
from .model import Model

# a larger error of the simulated position does not confirm the estimate
MAX_TRACKING_PERCENT = 20.0
MIN_F = 1.0  # of the first stage: with less, instruments explain nothing of W


def status_of(
    model: Model, last: Pass, best: Pass, first_stage_F: float
) -> tuple[Status, str | None]:
    """`converged` needs settled passes, simulated instruments that explain W, and a simulation
    that tracks the recording; or instruments along the motion that the reference predicts which
    stand alone, and explain W.

    Other settled passes are `not_confirmed`. Every joint has to track: the mean over the robot
    would hide a joint of small travel.
    """
    unconfirmed = None if best.by_reference else _unconfirmed(model, best)
    if last.failure is not None:
        return "diverged", last.failure
    if not first_stage_F >= MIN_F:
        return (
            "diverged",
            "the simulated motion does not resemble the measured one: first-stage "
            f"F = {first_stage_F:.2g}",
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
    return "max_iterations", f"after {last.number} passes {still}"


def _unconfirmed(model: Model, best: Pass) -> str | None:
    """Why the simulation with the final estimate does not confirm it; None if it does."""
    reasons, x = list[tuple[str, str | None]](), model.x_of(best.estimate, best.x)
    for one in model.equations:
        problem = one.problem
        chi = problem.base.standard_parameters(one.arm.beta(x))
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


def tests_of(one: Pass) -> tuple[float, float]:
    """Return strength and first-stage F of the instruments of a pass."""
    assert one.rows is not None
    system, estimate = one.rows.system, one.estimate
    indices = np.array([system.names.index(name) for name in estimate.names])
    W, _ = system.with_columns(indices).weighted(estimate.weights)
    return first_stage(estimate.Q, W, estimate.rows)


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
