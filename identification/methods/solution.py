"""The solution of a method: its estimate, and the inputs of its tests.

With instruments it includes how the iterations ended, and whether the simulated robot confirms the
estimate. For least squares it includes the test of noise bias, by simulation and extrapolation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..data import ON_GRID
from ..errors import NoFitError
from ..estimation import (
    Estimate,
    Intervals,
    changes_of,
    essential_names,
    intervals_from,
    intervals_of,
    not_below_white,
)
from ..regression import (
    FilteredMotion,
    Lag,
    Problem,
    Rows,
    equation_alone,
    fast_size,
    rows_of_recording,
    sample_weights,
    why_not_simulated,
)
from ..report import (
    DirectModelResidual,
    FTest,
    Method,
    Status,
    TrustResult,
    base_name,
    is_base,
)
from ..simulation import Simulated
from ..trust import FIXED_POINT, POSITION_NOISE, TrustInputs, control_law_line, fixed_point_line
from .iteration import MIN_F, Loop
from .model import Model
from .passes import Pass, join_reasons
from .start import solver_of

# A simulated position with a larger error does not confirm the estimate.
MAX_TRACKING_PERCENT = 20.0
CORRELATIONS = np.linspace(0.0, 0.95, 39)  # AR(1) coefficients tried for the noise
BANDS = 12  # frequency bands above the low-pass in which spectra are compared
MAX_CUTOFF = 0.3  # share of the sample rate: above it too little of the noise is free of motion
# Both in half-widths and in percent of the value: half of a wide interval may be a large error.
MAX_BIAS = ((1.0, 1.0), (0.5, 5.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """A solution of the method, before its tests.

    Attributes:
        model: recordings and unknowns.
        x: (p,) values of the estimate.
        inputs: inputs of the tests.
        least_squares: the fit itself, or for `iv` weighted least squares with the same recordings
            and settings.
        essential: test that finds the essential parameters.
        simulated: robot simulated with the estimate, by recording; empty for least squares.
        status: how the iterations ended; `solved` for least squares.
        reason: reason for the status; None for `converged` with instruments of a simulated robot.
        start: start of the iterations, as in `Iteration`.
        passes: iterations of the instrumental variable method, in order.
        returned: number of the iteration whose estimate is returned, counted from 1.
        strength: strength of the instruments, as in `estimation.first_stage`.
        method_reason: reason for the method.
    """

    model: Model
    x: Array
    inputs: TrustInputs
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


def inputs_of(
    model: Model,
    method: Method,
    solved: Pass,
    x: Array,
    full: Estimate,
    essential: FTest,
) -> TrustInputs:
    """Return the inputs of the tests of a solution.

    Parameters
    ----------
    model : recordings and unknowns.
    method : how it was solved.
    solved : the iteration or least squares, with its rows.
    x : (p,) values of the estimate.
    full : least squares of all parameters.
    essential : test that finds the essential parameters.
    """
    estimate, unknowns, rows = solved.estimate, model.unknowns, solved.kept
    candidates, *_ = model.candidates(x, (rows.speed, rows.most), simulated=not rows.recorded)
    lags = counted_lags(model, solved.lags, rows, estimate)
    within = intervals_with_given_uncertainty(model, estimate, rows, lags)
    problems = model.concluded(x)
    return TrustInputs(
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
        essential=tuple(filter(is_base, essential_names(essential, estimate, within))),
        made={
            "convergence": FIXED_POINT.judge({"least squares": True}),
            "control law": control_law_line(problems, model.laws),
        },
    )


def counted_lags(
    model: Model, lags: Sequence[Lag], rows: Rows, estimate: Estimate
) -> tuple[Lag, ...]:
    """Return the delays with their recordings, and the change of the estimate by one sd of each."""
    moves, names = changes_of(rows.system, rows.L[:, -len(lags) :], estimate), model.recordings
    return tuple(
        replace(lag, moved=lag.sd_s * np.abs(move), recordings=tuple(names[k] for k in group))
        for lag, group, move in zip(lags, model.unknowns.groups, moves.T, strict=True)
    )


def intervals_with_given_uncertainty(
    model: Model, estimate: Estimate, rows: Rows, lags: Sequence[Lag]
) -> Intervals:
    """Return intervals that include the uncertainty of values that the estimate holds.

    These are delays, and given drive gains, masses and centres of mass that are not estimated. A
    held value with standard error s, or a delay with standard deviation s, adds (s d beta / d
    value)² to the variance.
    """
    of, found = model.unknowns, intervals_of(rows.system, estimate)
    moved = [lag.moved for lag in lags]
    if of.held:
        places = [of.names.index(name) for name in estimate.names]
        half = np.array([[one.half] for one in of.held])
        moves = changes_of(rows.system, rows.L[:, : len(of.held)], estimate).T
        stated = np.array([one.stated[places] for one in of.held])
        moved += list(half * np.abs(stated - moves) / found.reach)
    return intervals_from(
        estimate, np.hypot.reduce([not_below_white(estimate, found), *moved]), found.freedom
    )


def solution_by_instruments(
    loop: Loop,
    concluded: tuple[Pass, tuple[Simulated, ...]],
    passes: Sequence[Pass],
    ended: tuple[Status, str | None],
    tests: tuple[float, float],
) -> Solution:
    """Return the solution of the iteration that is returned, with the robot that confirms it.

    Parameters
    ----------
    loop : the prepared iterations.
    concluded : the iteration, and the robot simulated with its estimate, by recording.
    passes : all iterations, beginning with least squares, without rows.
    ended : status and reason, as returned by `status_of`.
    tests : strength and first-stage F of the instruments.
    """
    (best, confirmed), model = concluded, loop.model
    x = model.x_of(best.estimate, best.x)
    tau, (predicted,), *_ = model.torques(x)
    solved = replace(best, rows=replace(best.kept, tau=tau, late=None), tau_predicted=predicted)
    (status, reason), (strength, F) = ended, tests
    if reason is not None and best.number != passes[-1].number:
        reason += f"; iteration {best.number} is returned, whose simulation tracks best"
    inputs = inputs_of(model, "iv", solved, x, loop.start.estimate, loop.essential)
    line = fixed_point_line(status, reason, gains=bool(inputs.gains))
    return Solution(
        model=model,
        x=x,
        inputs=replace(inputs, first_stage_F=F, made={**inputs.made, "convergence": line}),
        least_squares=loop.ls,
        essential=loop.essential,
        simulated=confirmed,
        status=status,
        reason=reason,
        start=loop.iteration.start,
        passes=tuple(passes[1:]),
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
    """Return the status of the iterations and its reason.

    `converged` needs iterations that converged with simulated instruments that explain W, and a
    simulation that tracks the recording at every joint; a mean over the joints would hide a joint
    of small travel. Instruments from the reference need no simulation if they explain W. Other
    converged iterations are `not_confirmed`. `failure` is the reason why the iteration after the
    `last` gave no estimate.
    """
    best, confirmed = concluded
    if failure is not None:
        return "diverged", failure
    if not first_stage_F >= MIN_F:
        return (
            "diverged",
            "the simulated motion does not resemble the measured one: first-stage "
            f"F = {first_stage_F:.2g}",
        )
    if best.by_reference:
        return "converged", f"instruments from the reference; {best.by_reference}"
    unconfirmed = _unconfirmed(model, best, confirmed)
    if last.is_last:
        if unconfirmed is None and last.kind != "simulated":
            unconfirmed = f"converged without simulated instruments: {last.reason}"
        return ("converged", None) if unconfirmed is None else ("not_confirmed", unconfirmed)
    if unconfirmed is not None:
        return "diverged", unconfirmed
    moving = list[str]()
    if not last.parameters_settled:
        moving.append(f"{last.changed} still changes by {last.change_sigma:.2g} standard errors")
    if last.residual_change_percent is not None:
        moving.append(f"the residual norm still changes by {last.residual_change_percent:.2g} %")
    text = " and ".join(moving) or "there is only the start"
    return "max_iterations", f"after iteration {last.number} {text}"


def _unconfirmed(model: Model, best: Pass, confirmed: Sequence[Simulated]) -> str | None:
    """Return why a simulation with the final estimate does not confirm it; None if it does."""
    x = model.x_of(best.estimate, best.x)
    reasons = [
        (one.problem.signals.recording, why_not_simulated(one.problem, one.arm, x))
        for one in model.equations
    ]
    if (reason := join_reasons(reasons)) is not None:
        return f"the final estimate cannot be simulated: {reason}"
    percents = [np.inf if one.percent is None else one.percent for one in confirmed]
    if not max(percents) <= MAX_TRACKING_PERCENT:
        return "the simulated position does not follow the measured one"
    far = (
        f"simulated joint {d.name} differs by {percent:.1f} % from the measured one"
        for d in direct_errors(confirmed)
        if (percent := d.position_error_percent) is not None and not percent <= MAX_TRACKING_PERCENT
    )
    return next(far, None)


def direct_errors(z: Sequence[Simulated]) -> tuple[DirectModelResidual, ...]:
    """Return the largest errors of the simulated robot in any recording, by joint.

    The result is empty if a recording could not be simulated.
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
    """Return the maximum, ignoring None (a joint that does not move, or has no torque)."""
    return max((x for x in percents if x is not None), default=None)


def position_noise_line(
    problem: Problem, method: Method, ls: Pass, essential: FTest, *, alone: bool
) -> TrustResult | None:
    """Test for bias of least squares by position noise, in half-widths.

        bias ≈ (beta(q + e) + beta(q - e)) / 2 - beta(q)

    The added noise e has the spectrum found above the low-pass, over the whole band. The mean of
    both signs cancels what is linear in e; the rest is, to first order, the bias by the noise
    within the band. This is simulation and extrapolation: Cook, Stefanski, Simulation-extrapolation
    estimation in parametric measurement error models, JASA 89 (1994).

    `alone` is True if `ls` has only this recording, without load-dependent friction.
    """
    settings, reason, asked = problem.settings, _reason_against(problem), ls.estimate
    if reason is not None:
        return POSITION_NOISE.judge({"no noise": True}, reason=reason)
    problem = problem.first_minutes()
    noise = _noise_like(problem)
    try:
        plain = (
            asked
            if alone and problem.settings is settings
            else _least_squares(problem, method, asked)
        )
        both = [_least_squares(_with_noise(problem, way * noise), method, asked) for way in (1, -1)]
    except NoFitError as error:
        return POSITION_NOISE.judge({"no noise": True}, reason=str(error))
    names = tuple(x for x in essential.names if x in plain.names and x in asked.names)
    half = ls.intervals.half[[asked.names.index(name) for name in names]]
    beta = plain.values_of(names)
    off = np.abs(0.5 * (both[0].values_of(names) + both[1].values_of(names)) - beta)
    with np.errstate(divide="ignore", invalid="ignore"):
        widths, percents = (
            np.nan_to_num(off / half, posinf=np.inf),
            np.nan_to_num(100 * off / np.abs(beta)),
        )
    matters = np.any([(widths > a) & (percents > b) for a, b in MAX_BIAS], axis=0)
    worst = int(np.argmax(np.where(matters, widths, -1.0) if matters.any() else widths))
    return POSITION_NOISE.judge(
        {"biased": matters.any(), "ok": True},
        value=float(widths[worst]),
        name=names[worst],
        percent=percents[worst],
    )


def _reason_against(problem: Problem) -> str | None:
    """Return why the noise cannot be estimated; None if it can."""
    settings, signals = problem.settings, problem.signals
    if settings.cutoff_hz is None:
        return POSITION_NOISE.part("no low-pass")
    if settings.cutoff_hz > MAX_CUTOFF * signals.sample_rate_hz:
        return POSITION_NOISE.part("wide", cutoff_hz=settings.cutoff_hz)
    return POSITION_NOISE.part("interpolated") if signals.off_grid > ON_GRID else None


def _noise_like(problem: Problem) -> Array:
    """Return noise (N, n) with the spectrum of the positions well above low-pass and motion.

    It is white or AR(1), whichever fits. Rounding and most encoders give white noise; noise that
    falls with frequency is larger below the low-pass than above.
    """
    settings, fs, rng = problem.settings, problem.signals.sample_rate_hz, np.random.default_rng(0)
    # Samples after the used ones would not change the result of a long recording.
    q = problem.signals.q[: settings.stop + round(fs)]
    used, size = q[settings.start : settings.stop], fast_size(len(q))
    frequencies = np.fft.rfftfreq(size)
    above = used - problem.motion.between(settings.start, settings.stop, settings.cutoff_hz).q
    window = np.hanning(len(used))[:, None]
    power = np.abs(np.fft.rfft(above * window, size, axis=0)) ** 2 / np.sum(window**2)
    cosine = np.cos(2 * np.pi * frequencies)
    seen = np.flatnonzero(frequencies > max(1.5 * (settings.cutoff_hz or 0.0) / fs, 1 / 8))
    bands = [band for band in np.array_split(seen, BANDS) if len(band)]
    # A periodogram has an exponential distribution, whose median is log(2) times its mean.
    level = np.array([np.median(power[band], axis=0) for band in bands]) / np.log(2)
    phi, of_band = CORRELATIONS[:, None], np.array([cosine[band].mean() for band in bands])
    shapes = 1 / (1 - 2 * phi * of_band + phi**2)
    # The shape with the least scatter of log(level / shape) over the bands fits best:
    # (correlations, bands, n).
    off = np.log(np.maximum(level, 1e-300))[None] - np.log(shapes)[:, :, None]
    best = off.std(axis=1).argmin(axis=0)
    scale = np.exp(0.5 * off.mean(axis=1)[best, np.arange(q.shape[1])])
    white = np.fft.rfft(rng.standard_normal((size, q.shape[1])), axis=0) * scale
    turns = np.exp(-2j * np.pi * frequencies)[:, None]
    return np.fft.irfft(white / (1 - CORRELATIONS[best] * turns), size, axis=0)[: len(q)]


def _with_noise(problem: Problem, noise: Array) -> Problem:
    """Return the problem with added noise (N, n), and with unchanged weights of samples."""
    q = np.array(problem.signals.q)
    q[: len(noise)] += noise
    noisy = replace(problem, motion=FilteredMotion(problem.signals, q))
    sample_weights(noisy, sample_weights(problem))
    return noisy


def _least_squares(problem: Problem, method: Method, of: Estimate) -> Estimate:
    """Solve least squares of one recording for the parameters of another estimate.

    Load-dependent friction is not a part of it.
    """
    system = rows_of_recording(*equation_alone(problem)).system
    known = np.isin(system.names, [*map(base_name, of.names)]) & system.W.any(axis=0)
    return solver_of(method)(system.with_columns(np.flatnonzero(known)))
