"""Identifies, and judges what was found: torque errors, tests and warnings of a solution, its drive
gains and payloads, and the nearest physically consistent parameters, which a simulator accepts.

E_m is the torque of motor m by its described gain, kappa_m the factor on it: a term `Drives` like
the others, equation (I). What is stated of gains, masses and centres of mass has half-widths, which
intervals count. Results of gains and payloads stand apart from the base parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Robot

from ..arrays import Array
from ..data import Recordings, Signals
from ..estimation import (
    Estimate,
    autocorrelation,
    consistent_parameters,
    covariance_of_all,
    f_test,
    one_thread,
    parameter_certainty,
    relative_residual,
)
from ..methods import Iteration, Model, ProgressCallback, Solution, solve
from ..model import LINK, BaseParameters, InverseModel, expected_links, physical_parameters
from ..regression import ROWS, Overrides, Problem, recorded_power, sample_weights
from ..report import (
    ConsistentFile,
    DriveGain,
    FTest,
    Method,
    PayloadOfFit,
    StandardParameter,
    base_name,
    is_own,
)
from ..trust import MIN_FIRST_STAGE_F, TrustInputs, trust_in, with_predictions
from .evidence import Evidence, FitOnRecording, errors_on, validated
from .parameters import refuse_unknown_gain

SURROGATE = (
    "surrogate reference: none recorded, the measured position is used instead; the instruments "
    "are not strictly exogenous"
)
UNITS = (*["kg m²"] * 6, *["kg m"] * 3, "kg")  # of LINK
MAX_GAIN_SHARE = 0.1  # half an interval over the gain: with more it is not determined
MAX_SATURATED_PERCENT = 1.0  # of the samples: above, a warning
# of the variance by the prior alone: above, the value is more from the prior than the recording
MIN_PRIOR_SHARE = 0.5


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


def own_test(model: Model, x: Array, full: Estimate) -> FTest | None:
    """F test, by least squares, of the recordings' own parameters against shared ones;
    None if there are none.
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
    """Warnings of the settings and the recordings; several recordings may share one."""
    problems = [model.problems[k] for k in model.order]
    of_settings = [
        text
        for p in problems
        for text in (
            *p.for_errors.settings.warnings,
            *_short_moves(p),
            *_gain_warnings(p.signals),
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


def _gain_warnings(signals: Signals) -> tuple[str, ...]:
    """A warning of the units if the drive gains are not given."""
    robot = signals.robot
    if robot.gain_known:
        return ()
    units = " and ".join(sorted(set(robot.effort_units)))
    text = f"the drive gains are not known: torques and parameters are in {units}, not in N m"
    if robot.n > 1:
        text += (
            "; joints share parameters, so the values are valid only if all drives have the same "
            "gain"
        )
    return (text,)


def gains_of(model: Model, data: TrustInputs) -> tuple[DriveGain, ...]:
    """The drive gains that were identified, in the order of their motors."""
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
    """The payloads as the nearest bodies of positive density, and warnings of those that are near
    none.
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Known:
    """An estimate beta (b,), its covariance C = D R D (b, b), and `reach`, deviations
    in half a 95 % interval.
    """

    beta: Array
    covariance: Array
    reach: float


@one_thread
def with_consistent(fit: Evidence, prior: Robot | None = None) -> Evidence:
    """The fit with the nearest physically consistent parameters and their torque error; the
    estimate stays the same.

    `prior` describes the a-priori links; None: the fitted description. Raises `BadInputError`: a
    drive gain is not known, the prior is of another robot, or no consistent parameters are found.
    """
    own = fit.recordings[0].names  # of own parameters those of one recording
    known = Known(
        beta=fit.beta,
        covariance=covariance_of_all(own, fit.estimate, fit.intervals, fit.full),
        reach=fit.intervals.reach,
    )
    power = recorded_power([one.problem for one in fit.recordings if one.names == own], fit.beta)
    found, standard = consistent_set(fit.problem.model, fit.base, known, prior=prior, power=power)
    beta = np.array([one.value for one in found.base_parameters or ()])
    *_, error = errors_on([validated(one.problem, beta + one.carried) for one in fit.recordings])
    found = msgspec.structs.replace(found, relative_error_percent=error.relative_error_percent)
    return replace(fit, consistent_set=found, standard_parameters=standard)


@one_thread
def consistent_set(
    model: InverseModel,
    base: BaseParameters,
    known: Known,
    *,
    prior: Robot | None = None,
    power: Array | None = None,
) -> tuple[ConsistentFile, tuple[StandardParameter, ...]]:
    """The physically consistent base and standard parameters nearest to the `known` base
    parameters of a robot, by the links of `prior`; None: of its own description. `power`: of
    friction at recorded speeds, for further friction terms; None without such terms or known
    speeds. Raises as `with_consistent`.
    """
    refuse_unknown_gain(model.robot)
    expected = None if prior is None else InverseModel(prior)
    physical = physical_parameters(model, expected, power)
    found = consistent_parameters(known.beta, known.covariance, base.K, physical)
    (sigma, share), (base_sigma, base_share) = parameter_certainty(
        found, known.covariance, base.K, physical
    )
    moves, reach = found.deviations / known.reach, known.reach
    of_base = standard_parameters(
        base.names, base.units, found.beta, reach * base_sigma, base_share > MIN_PRIOR_SHARE, moves
    )
    return ConsistentFile(
        prior=f"{'the description' if prior is None else prior.name}: "
        f"{_in_words(expected_links(model, expected)[1])}",
        chi2=found.chi_squared,
        largest_move=float(np.abs(moves).max()),
        moved_most=base.names[int(np.abs(found.deviations).argmax())],
        certificate=found.decrement,
        base_parameters=list(of_base),
    ), standard_parameters(
        model.names, model.units, found.chi, reach * sigma, share > MIN_PRIOR_SHARE
    )


def standard_parameters(
    names: Sequence[str], units: Sequence[str], values: Array, *columns: NDArray[Any]
) -> tuple[StandardParameter, ...]:
    """Parameters by values (p,), half-widths, whether they are from the prior and, of base
    parameters, moves.
    """
    half, from_prior, *moves = (x.tolist() for x in columns)
    return tuple(map(StandardParameter, names, values.tolist(), units, from_prior, half, *moves))


def _in_words(sources: tuple[str, ...]) -> str:
    """`links 1, 2 by the URDF; link 3 by their lengths (guess)`."""
    words = {
        "[parameters]": "by [parameters]",
        "URDF": "by the URDF",
        "plausible": "by their lengths (guess)",
    }
    of = {source: [str(j + 1) for j, s in enumerate(sources) if s == source] for source in words}
    return "; ".join(
        f"{'all links' if len(links) == len(sources) else 'links ' + ', '.join(links)} "
        f"{words[source]}"
        for source, links in of.items()
        if links
    )
