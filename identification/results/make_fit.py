"""Identification, and the assessment of its solution.

The assessment consists of the torque errors, tests and warnings of a solution, its drive gains and
payloads.

E_m is the torque of motor m by its described gain, kappa_m the factor on it: a term `Drives` like
the others, equation (I). What is given of gains, masses and centres of mass has half-widths, which
intervals count. Results of gains and payloads stand apart from the base parameters.
"""

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
)
from ..methods import Iteration, Model, ProgressCallback, Solution, solve
from ..model import LINK
from ..regression import ROWS, Overrides, Problem, sample_weights
from ..report import (
    DriveGain,
    FTest,
    Method,
    PayloadOfFit,
    base_name,
    is_own,
)
from ..trust import MIN_FIRST_STAGE_F, TrustInputs, trust_in, with_predictions
from .consistent import standard_parameters
from .evidence import Evidence, FitOnRecording, errors_on

SURROGATE = (
    "surrogate reference: none recorded, the measured position is used instead; the instruments "
    "are not strictly exogenous"
)
UNITS = (*["kg m²"] * 6, *["kg m"] * 3, "kg")  # of LINK
MAX_GAIN_SHARE = 0.1  # half an interval over the gain: with more it is not determined
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

    Parameters and errors are those of `methods.solve`. The status of least squares is `solved`;
    that of `iv` is `converged` only if two iterations agree and the robot simulated with the
    estimate follows the recording, or if instruments of the reference alone suffice.
    """
    solution = solve(
        signals, overrides, method=method, iteration=iteration, essential=essential, say=say
    )
    model, x, z = solution.model, solution.x, solution.simulated
    data, held_out, (tau, predicted, counts, t_s) = with_predictions(
        solution.inputs, partial(model.torques, x, judged=True)
    )
    ends = np.cumsum([*map(len, t_s)])[:-1]
    parts = zip(
        data.problems,
        model.unknowns.arms,
        *(np.split(x, ends) for x in (tau, predicted, counts)),
        strict=True,
    )
    fitted = [
        FitOnRecording(
            problem=problem,
            names=arm.names,
            carried=arm.carried(data.estimate),
            beta=arm.values(data.estimate),
            t_s=t_s[k],
            tau=tau,
            tau_predicted=predicted,
            counts=counts,
            held_out=held_out[k] if held_out else None,
            simulated=z[k] if z else None,
        )
        for k, (problem, arm, tau, predicted, counts) in enumerate(parts)
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


def identify_ls(
    signals: Signals | Recordings,
    overrides: Overrides,
    *,
    method: Literal["ols", "wls"] = "wls",
    essential: bool = False,
    say: ProgressCallback = lambda text: None,
) -> Evidence:
    """Identify the base parameters by least squares, IDIM-LS (Janot2014, section 2).

    Parameters
    ----------
    signals : the recording, or several recordings of one robot.
    overrides : settings that replace those of the description; `Overrides()` for none.
    method : `wls`, weighted by joint, or `ols`, without weights.
    essential : True to fit only the essential parameters.
    say : called with a line of text for each step.

    Returns
    -------
    The fit; its status is `solved`.

    Raises
    ------
    NoFitError : a recording is too short, or the recordings excite too little.
    BadInputError : the recordings are not of one robot, or a setting is out of range.
    """
    return identify(signals, overrides, method=method, essential=essential, say=say)


def identify_iv(
    signals: Signals | Recordings,
    overrides: Overrides,
    iteration: Iteration,
    *,
    essential: bool = False,
    say: ProgressCallback = lambda text: None,
) -> Evidence:
    """Identify the base parameters by instrumental variables, IDIM-IV (Janot2014, section 3).

    Parameters
    ----------
    signals : the recording, or several recordings of one robot.
    overrides : settings that replace those of the description; `Overrides()` for none.
    iteration : start and end of the iterations; `Iteration()` for the defaults.
    essential : True to fit only the essential parameters.
    say : called with a line of text for each step.

    Returns
    -------
    The fit; its status is `converged` only if two iterations agree and the robot simulated with the
    estimate follows the recording, or if the instruments from the reference suffice.

    Raises
    ------
    NoFitError : a recording is too short, the recordings excite too little, or the first iteration
        gives no estimate.
    BadInputError : the recordings are not of one robot, or a setting is out of range.
    """
    return identify(
        signals, overrides, method="iv", iteration=iteration, essential=essential, say=say
    )


def own_test(model: Model, x: Array, full: Estimate) -> FTest | None:
    """Test per-recording parameters against shared ones.

    It is an F test by least squares. The result is None without per-recording parameters.
    """
    if not (own := tuple(filter(is_own, model.unknowns.names))):
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
    """Return warnings of the settings and the recordings; several recordings may share one."""
    problems = [model.problems[k] for k in model.order]
    of_settings = [
        text
        for p in problems
        for text in (
            *p.for_errors.settings.warnings,
            *_short_moves(p),
            *_gain_warnings(p.signals),
            *(
                f"joint {joint} was corrected from a recording, and nobody has checked it yet"
                for joint in p.signals.robot.unconfirmed
            ),
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
    """Return a warning on joints whose weight taper is shorter than that of the settings.

    The list is empty if there are no such joints.
    """
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


def _gain_warnings(signals: Signals) -> tuple[str, ...]:
    """Return a warning on units if the drive gains are not given."""
    robot = signals.robot
    if robot.gain_known:
        return ()
    units = " and ".join(sorted(set(robot.effort_units)))
    return (
        f"the drive gains are not known: torques and parameters are in {units}, not in N m"
        + "; joints share parameters, so the values are valid only if all drives have the same gain"
        * (robot.n > 1),
    )


def smallest_cragg_donald(data: TrustInputs) -> float:
    """Return the smallest eigenvalue of the Cragg–Donald statistic, per instrument.

    It is that of (E, Ê) projected off W and L: Cragg, Donald, Testing identifiability and
    specification in instrumental variable models, Econometric Theory 9 (1993). The first-stage F of
    a gain cannot detect weak instruments, because W explains the current.
    """
    system, Z, w = data.observed.system, data.observed.Z, data.weight[:, None]
    gains = [system.names.index(name) for name in data.gains]
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


def gains_of(model: Model, data: TrustInputs) -> tuple[DriveGain, ...]:
    """Return the drive gains that were identified, in the order of their motors."""
    of, robot = model.unknowns, data.problems[0].signals.robot
    motors, places = [*of.motors], [data.estimate.names.index(name) for name in of.names[of.gains]]
    values = (robot.gain[motors] * data.estimate.beta[places]).tolist()
    widths = (np.abs(robot.gain[motors]) * data.intervals.half[places]).tolist()
    return tuple(
        DriveGain(
            motor=robot.motors[m].name,
            unit=f"{robot.effort_units[m]}/{robot.motors[m].recorded_unit}",
            described=robot.motors[m].gain,
            value=value,
            half_width=width,
            determined=width < MAX_GAIN_SHARE * abs(value),
        )
        for m, value, width in zip(motors, values, widths, strict=True)
    )


def payloads_of(model: Model, data: TrustInputs) -> tuple[tuple[PayloadOfFit, ...], list[str]]:
    """Return the payloads as the nearest rigid bodies with positive mass density.

    Payloads that are near none give warnings.
    """
    estimate, found, problem = data.estimate, data.intervals, data.problems[0]
    payloads, far = list[PayloadOfFit](), list[str]()
    for one in model.unknowns.payloads:
        own = [estimate.names.index(name) for name in one.names if name in estimate.names]
        covariance = found.covariance[np.ix_(own, own)] if len(own) == len(one.names) else None
        values, sigma, prior = one.nearest_body(estimate.values_of(one.names), covariance)
        name = model.recordings[[arm.payload for arm in model.unknowns.arms].index(one)]
        if one.names and not sigma.any():
            far.append(
                f"payload of {name}: no body of positive density is near: its values are stated or "
                "a ball's"
            )
        half, stated = found.reach * sigma, one.payload
        payloads.append(
            PayloadOfFit(
                recording=name,
                stated=stated.text,
                parameters=list(standard_parameters(LINK, UNITS, values, half, prior)),
                base_parameters=dict(
                    zip(problem.base.names, one.values(estimate).tolist(), strict=True)
                ),
                described=stated.describe(problem.signals.robot.joints[-1].name),
                given=["mass"] * (stated.mass_kg is not None)
                + ["center"] * (stated.center_of_mass_m is not None),
                mass_half_width_kg=stated.mass_half_width_kg or None,
            )
        )
    return tuple(payloads), far
