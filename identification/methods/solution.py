"""The solution of a method: the estimate with the inputs of its tests; with instruments also how
the passes ended, and whether the simulated robot confirms the estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from ..arrays import Array
from ..estimation import (
    Estimate,
    Intervals,
    intervals_from,
    intervals_of,
    moves_of,
    not_below_white,
)
from ..model import direct_model, why_not_positive
from ..regression import Lag, Rows
from ..report import DirectModelResidual, FTest, Method, Status, is_base
from ..simulation import Simulated
from ..trust import FIXED_POINT, FitData, control_law_line, fixed_point_line
from .iteration import MIN_F, Loop
from .model import Model
from .passes import Pass, join_reasons

# a larger error of the simulated position does not confirm the estimate
MAX_TRACKING_PERCENT = 20.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """What a method found, before its tests.

    Attributes:
        model: recordings and unknowns; `x`: (p,) the values of the estimate.
        evidence: inputs of the tests.
        least_squares: that of the fit itself or, of `iv`, weighted least squares of the same
            recordings and settings; `essential`: the parameters that are essential by it.
        simulated: by recording, the robot simulated with the estimate; none after least squares.
        status: `solved` by least squares; `reason`: of another one, None for `converged` with
            instruments of a simulated robot.
        passes: of the instrumental variable method, in order, from a `start` as of `Iteration`.
            `returned` is the number, counted from 1, of the one whose estimate this is.
        strength: of the instruments, as of `estimation.first_stage`.
        method_reason: why this method.
    """

    model: Model
    x: Array
    evidence: FitData
    least_squares: Pass
    essential: FTest
    simulated: tuple[Simulated, ...] = ()
    status: Status = "solved"
    reason: str | None = None
    start: str = ""
    passes: tuple[Pass, ...] = ()
    returned: int = 0
    strength: float = 1.0
    method_reason: str = "as requested"


def essential_names(essential: FTest, estimate: Estimate, found: Intervals) -> tuple[str, ...]:
    """The essential parameters of an estimate whose 95 % interval is narrower than their value."""
    certain = found.half < np.abs(estimate.beta)
    names = compress(estimate.names, certain)
    return tuple(name for name in names if is_base(name) and name in essential.names)


def evidence_of(
    model: Model,
    method: Method,
    solved: Pass,
    x: Array,
    full: Estimate,
    essential: FTest,
) -> FitData:
    """Inputs of the trust tests of a solution and its x (p,), with the columns of candidates in
    its rows; `full`, `essential`: least squares of all parameters, and those essential by it.
    """
    estimate, unknowns, rows = solved.estimate, model.unknowns, solved.rows
    assert rows is not None
    candidates, *_ = model.candidates(x, (rows.speed, rows.most), simulated=not rows.recorded)
    lags = counted_lags(model, solved.lags, rows, estimate)
    within = held_and_counted(model, estimate, rows, lags)
    problems = model.concluded(x)
    return FitData(
        problems=problems,
        arms=unknowns.arms,
        observed=rows,
        method=method,
        estimate=estimate,
        predicted=solved.tau_predicted,
        intervals=within,
        least_squares=full,
        candidates=candidates,
        lags=lags,
        essential=essential_names(essential, estimate, within),
        made={
            "fixed point": FIXED_POINT.judge({"least squares": True}),
            "control law": control_law_line(problems, model.laws),
        },
    )


def counted_lags(
    model: Model, lags: Sequence[Lag], rows: Rows, estimate: Estimate
) -> tuple[Lag, ...]:
    """The lags with their recordings, and the moves of an estimate by one deviation of each."""
    moves, found = moves_of(rows.system, rows.L[:, -len(lags) :], estimate), []
    for lag, group, move in zip(lags, model.unknowns.groups, moves.T, strict=True):
        names = tuple(model.problems[k].signals.recording for k in group)
        found.append(replace(lag, moved=lag.sd_s * np.abs(move), recordings=names))
    return tuple(found)


def held_and_counted(
    model: Model, estimate: Estimate, rows: Rows, lags: Sequence[Lag]
) -> Intervals:
    """Intervals that include how well lags, stated drive gains, masses, and centres of mass
    that are not estimated are known, which the estimate holds.
    """
    of, found = model.unknowns, intervals_of(rows.system, estimate)
    moved = [lag.moved for lag in lags]
    if of.held:
        places = [of.names.index(name) for name in estimate.names]
        half = np.array([[one.half] for one in of.held])
        moves = moves_of(rows.system, rows.L[:, : len(of.held)], estimate).T
        stated = np.array([one.stated[places] for one in of.held])
        moved += list(half * np.abs(stated - moves) / found.reach)
    sigma = not_below_white(estimate, found)
    return intervals_from(estimate, np.hypot.reduce([sigma, *moved]), found.freedom)


def solution_by_instruments(
    loop: Loop,
    concluded: tuple[Pass, tuple[Simulated, ...]],
    passes: Sequence[Pass],
    ended: tuple[Status, str | None],
    tests: tuple[float, float],
) -> Solution:
    """The solution of the pass that is returned with the robot that confirms it, how the passes
    `ended`, and the `tests` of its instruments.
    """
    best, confirmed = concluded
    model, estimate, rows = loop.model, best.estimate, best.rows
    assert rows is not None
    x = model.x_of(estimate, best.x)
    tau, (predicted,), *_ = model.torques(x)
    solved = replace(best, rows=replace(rows, tau=tau, late=None), tau_predicted=predicted)
    (status, reason), (strength, F) = ended, tests
    if reason is not None and best.number != len(passes):
        reason += f"; pass {best.number} is returned: it tracks best"
    evidence = evidence_of(model, "iv", solved, x, loop.start.estimate, loop.essential)
    line = fixed_point_line(status, reason, gains=bool(evidence.gains))
    return Solution(
        model=model,
        x=x,
        evidence=replace(evidence, first_stage_F=F, made={**evidence.made, "fixed point": line}),
        least_squares=loop.ls,
        essential=loop.essential,
        simulated=confirmed,
        status=status,
        reason=reason,
        start=loop.iteration.start,
        passes=tuple(passes),
        returned=best.number,
        strength=strength,
    )


def status_of(
    model: Model,
    last: Pass,
    concluded: tuple[Pass, tuple[Simulated, ...]],
    first_stage_F: float,
    failure: str | None,
) -> tuple[Status, str | None]:
    """`converged` needs settled passes, simulated instruments that explain W, and a simulation
    that tracks the recording; or instruments along the motion that the reference predicts which
    stand alone, and explain W.

    Other settled passes are `not_confirmed`. Every joint has to track: the mean over the robot
    would hide a joint of small travel. `failure`: why the pass after the last gave no estimate.
    """
    best, confirmed = concluded
    unconfirmed = None if best.by_reference else _unconfirmed(model, best, confirmed)
    if failure is not None:
        return "diverged", failure
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
    if (percent := last.residual_change_percent) is not None:
        moving.append(f"the residual norm still changes by {percent:.2g} %")
    still = " and ".join(moving) or "only the start is known"
    return "max_iterations", f"after {last.number} passes {still}"


def _unconfirmed(model: Model, best: Pass, confirmed: Sequence[Simulated]) -> str | None:
    """Why the simulation with the final estimate does not confirm it; None if it does."""
    reasons, x = list[tuple[str, str | None]](), model.x_of(best.estimate, best.x)
    for one in model.equations:
        problem = one.problem
        chi = problem.base.standard_parameters(one.arm.beta(x))
        M = direct_model(problem.model, chi).inertia(problem.poses)
        reasons.append((problem.signals.recording, why_not_positive(M)))
    if (reason := join_reasons(reasons)) is not None:
        return f"the final estimate cannot be simulated: {reason}"
    percents = [np.inf if one.percent is None else one.percent for one in confirmed]
    if not max(percents) <= MAX_TRACKING_PERCENT:
        return "the simulated position does not follow the measured one"
    for d in direct_errors(confirmed):
        if (
            d.position_error_percent is not None
            and not d.position_error_percent <= MAX_TRACKING_PERCENT
        ):
            return (
                f"simulated joint {d.name} differs by {d.position_error_percent:.1f} % from "
                "the measured one"
            )
    return None


def direct_errors(z: Sequence[Simulated]) -> tuple[DirectModelResidual, ...]:
    """Largest errors of the simulated robot in any recording, by joint; none if one
    could not be simulated.
    """
    return tuple(
        DirectModelResidual(
            name=joint[0].name,
            position_error_percent=largest([d.position_error_percent for d in joint]),
            torque_error_percent=largest([d.torque_error_percent for d in joint]),
        )
        for joint in zip(*(one.by_joint for one in z), strict=False)
    )


def largest(percents: list[float | None]) -> float | None:
    """The largest that is not None: a joint may stand in one recording, or have no torque."""
    return max((x for x in percents if x is not None), default=None)
