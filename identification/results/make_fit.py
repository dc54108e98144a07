"""Identifies, and judges what was found: torque errors, tests and warnings of a solution."""

from functools import partial
from typing import Literal

import numpy as np

from ..arrays import Array
from ..data import Recordings, Signals
from ..estimation import (
    Estimate,
    autocorrelation,
    f_test,
    one_thread,
    relative_residual,
    spans_of,
)
from ..methods import Iteration, Model, ProgressCallback, Solution, solve
from ..regression import ROWS, Overrides, Problem, sample_weights
from ..report import FTest, Method, base_name
from ..trust import MIN_FIRST_STAGE_F, trust_in, with_predictions
from .evidence import Evidence, FitOnRecording, errors_on
from .gain_results import gains_of, payloads_of
from .recording_report import gain_warnings

SURROGATE = (
    "surrogate reference: none recorded, the measured position is used instead; the instruments "
    "are not strictly exogenous"
)
MAX_SATURATED_PERCENT = 1.0  # of the samples: above, a warning


@one_thread
def identify(
    signals: Signals | Recordings,
    overrides: Overrides,
    *,
    method: Method | None = None,
    iteration: Iteration | None = None,
    essential: bool = False,
    say: ProgressCallback = lambda text: None,
) -> Evidence:
    """Identify base parameters, and judge the fit by its tests.

    Parameters and errors as of `methods.solve`. The status of least squares is `solved`; that of
    `iv` is `converged` only if two passes agree and the robot simulated with the estimate follows
    the recording, or if instruments of the reference alone suffice.
    """
    return fit_of(
        solve(signals, overrides, method=method, iteration=iteration, essential=essential, say=say)
    )


def identify_ls(
    signals: Signals | Recordings,
    overrides: Overrides,
    *,
    method: Literal["ols", "wls"] = "wls",
    essential: bool = False,
    say: ProgressCallback = lambda text: None,
) -> Evidence:
    """Identify by least squares, IDIM-LS, section 2 of Janot2014; parameters as of `identify`."""
    return identify(signals, overrides, method=method, essential=essential, say=say)


def identify_iv(
    signals: Signals | Recordings,
    overrides: Overrides,
    iteration: Iteration,
    *,
    essential: bool = False,
    say: ProgressCallback = lambda text: None,
) -> Evidence:
    """Identify by instrumental variables, IDIM-IV, section 3 of Janot2014; as of `identify`."""
    return identify(
        signals, overrides, method="iv", iteration=iteration, essential=essential, say=say
    )


def fit_of(solution: Solution) -> Evidence:
    """The fit of a solution: its torque errors, its tests, its warnings, gains and payloads."""
    model, x, z = solution.model, solution.x, solution.simulated
    data, held_out, (tau, predicted, counts, t_s) = with_predictions(
        solution.inputs, partial(model.torques, x, judged=True)
    )
    parts = zip(data.problems, model.unknowns.arms, spans_of([*map(len, t_s)]), strict=True)
    fitted = [
        FitOnRecording(
            problem=problem,
            names=arm.names,
            carried=arm.carried(data.estimate),
            beta=arm.values(data.estimate),
            t_s=t_s[k],
            tau=tau[part],
            tau_predicted=predicted[part],
            counts=counts[part],
            held_out=held_out[k] if held_out else None,
            simulated=z[k] if z else None,
        )
        for k, (problem, arm, part) in enumerate(parts)
    ]
    payloads, far = payloads_of(model, data)
    return Evidence(
        solution=solution,
        data=data,
        recordings=tuple(fitted[k] for k in model.order),
        errors=errors_on(fitted),
        trust=trust_in(data),
        own=own_test(model, x, data.least_squares),
        gains=gains_of(model, data),
        payloads=payloads,
        warnings=(*_warnings(model), *far, *(_iv_warnings(solution) if z else ())),
    )


def own_test(model: Model, x: Array, full: Estimate) -> FTest | None:
    """F test, by least squares, of the recordings' own parameters against shared ones;
    None if there are none.
    """
    if not (own := model.unknowns.own):
        return None
    rows, names = model.rows(model.x_of(full, x)), [*map(base_name, full.names)]
    W, Y = rows.of(model.unknowns.arm).weighted(full.weights)
    shared = list(dict.fromkeys(names))
    merge = np.array([[float(name == one) for one in shared] for name in names])
    norm, left = (relative_residual(A, Y) for A in (W, W @ merge))
    rho = (rows.tau - model.predicted(rows.x, full)) * full.weights * rows.counts
    extra, freedom = len(names) - len(shared), full.rows - len(names)
    F = (left**2 - norm**2) / extra / (norm**2 / freedom) if norm > 0 else float("inf")
    return f_test(own, F, extra, full.rows, len(names), autocorrelation(rho) or 0.0)


def _warnings(model: Model) -> tuple[str, ...]:
    """Warnings of the settings and the recordings; several recordings may share one."""
    problems = [model.problems[k] for k in model.order]
    of_settings = [
        text
        for p in problems
        for text in (
            *p.for_errors.settings.warnings,
            *_short_moves(p),
            *gain_warnings(p.signals),
        )
    ]
    named = [
        f"{p.signals.recording}: " * (len(problems) > 1) + f"recording: {event.text}"
        for p in problems
        for event in p.signals.events
        if event.kind == "warning"
    ]
    return (*dict.fromkeys(of_settings), *named)


def _short_moves(problem: Problem) -> list[str]:
    """Joints whose weights have shorter ramps than those of the settings, or none."""
    if not len(problem.signals.q):
        return []
    robot, asked = problem.signals.robot, problem.settings.ramp_rows
    return [
        f"joint {joint.name}: its moves are short for a bandwidth of {robot.bandwidth_hz:.3g} Hz: "
        + ("no weights, but rows in which it moves" if ramp == ROWS else f"ramps of {ramp:g} rows")
        for joint, ramp in zip(robot.joints, sample_weights(problem).ramps, strict=True)
        if ramp < asked or ramp == ROWS
    ]


def _iv_warnings(solution: Solution) -> tuple[str, ...]:
    model, z, F = solution.model, solution.simulated, solution.inputs.first_stage_F
    each = list(zip((problem.signals.robot for problem in model.problems), z, strict=True))
    without = [robot for robot, one in each if one.controller == "surrogate"]
    unknown = [
        robot for robot, one in each if one.controller != "surrogate" and not one.prior_known
    ]
    limits = (
        ", ".join(
            f"{m} in {x:.1f} %" for m, x in one.saturated.items() if x > MAX_SATURATED_PERCENT
        )
        for one in z
    )
    return (
        *([] if model.exogenous else [SURROGATE]),
        *(
            f"no controller described: simulated with a {robot.bandwidth_hz:g} Hz PD instead"
            for robot in without[:1]
        ),
        *(
            "least squares gives no positive inertias: the gain update uses those that suit the "
            f"described gains at {robot.bandwidth_hz:g} Hz"
            for robot in unknown[:1]
        ),
        *(f"drives at their limit: {found} of the samples" for found in limits if found),
        *(
            [f"weak instruments: first-stage F = {F:.2g}, below {MIN_FIRST_STAGE_F:g}"]
            if F is not None and F < MIN_FIRST_STAGE_F
            else []
        ),
    )
