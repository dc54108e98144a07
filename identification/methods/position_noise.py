"""Whether noise of the position biases least squares on a recording: its own noise added once more, and once less.

Simulation and extrapolation (Cook, Stefanski, Simulation-extrapolation estimation in parametric measurement error models, JASA
89 (1994)): white noise of the deviation found above the low-pass is added to the position over the whole band, with both signs;
the mean of the two moves is, to first order, the bias that the noise within the band has caused already. Rounding and noise of
an encoder are white across the cut-off.
"""

from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..data import ON_GRID, Signals
from ..errors import IdentificationError
from ..estimation import Estimate, ordinary_least_squares, weighted_least_squares
from ..regression import FilteredMotion, Problem, base_name, regression_of_recording
from ..trust import TrustLine
from .fit import LeastSquares, Method
from .recordings import SPAN_S, Observed

NAME = "position noise"
LARGEST_CUTOFF = 0.3  # of the sample rate: above it too little of the noise is seen alone
BIASED, BIASED_PERCENT = 1.0, 1.0  # half-widths, and percent of the value, that a bias may have
ADVICE = "take --method iv, which needs the reference recorded"


def position_noise_line(observed: Observed, method: Method, ls: LeastSquares) -> TrustLine:
    """How far noise of the position has moved least squares, in half-widths; of several recordings the first is looked at."""
    one = observed.observations[observed.order[0]]
    settings, fs = one.problem.settings, one.problem.signals.sample_rate_hz
    reason = _not_seen(one.problem)
    if reason is not None:
        return TrustLine(test=NAME, level="cannot tell", value=None, text=f"{reason}: {ADVICE}")
    assert settings.cutoff_hz is not None
    problem = observed.places()[observed.order[0]].problem()
    stop = min(settings.stop, settings.start + round(SPAN_S * fs))
    problem = replace(problem, settings=replace(settings, stop=stop))
    noise = np.random.default_rng(0).standard_normal(problem.signals.q.shape) * _deviations(problem)
    try:
        same = stop == settings.stop and len(observed.observations) == 1 and not observed.linearised.load
        plain = ls.estimate if same else _least_squares(problem, method, ls)
        both = [_least_squares(_with_position(problem, problem.signals.q + way * noise), method, ls) for way in (1, -1)]
    except IdentificationError as error:
        return TrustLine(test=NAME, level="cannot tell", value=None, text=f"{error}: {ADVICE}")
    names = [name for name in ls.essential.estimate.names if name in plain.names and name in ls.estimate.names]
    among = np.array([ls.estimate.names.index(name) for name in names])
    beta, half = plain.among(tuple(names)), ls.intervals.half[among]
    off = np.abs(0.5 * (both[0].among(tuple(names)) + both[1].among(tuple(names))) - beta)
    with np.errstate(divide="ignore", invalid="ignore"):
        widths, percents = np.nan_to_num(off / half, posinf=np.inf), np.nan_to_num(100 * off / np.abs(beta))
    matters = (widths > BIASED) & (percents > BIASED_PERCENT)
    worst = int(np.argmax(np.where(matters, widths, -1.0) if matters.any() else widths))
    value, text = (
        float(widths[worst]),
        f"moves {names[worst]} by {widths[worst]:.2g} half-widths ({percents[worst]:.2g} %)",
    )
    if matters.any():
        text = f"{text} or more: {ADVICE}"
        return TrustLine(
            test=NAME, level="caution", value=value, text=text, finding="least squares biased by position noise"
        )
    return TrustLine(test=NAME, level="ok", value=value, text=text)


def _not_seen(problem: Problem) -> str | None:
    settings, signals = problem.settings, problem.signals
    if settings.cutoff_hz is None:
        return "without a low-pass nothing tells the noise from the motion"
    if settings.cutoff_hz > LARGEST_CUTOFF * signals.sample_rate_hz:
        return f"above the cut-off of {settings.cutoff_hz:g} Hz too little of the noise is seen"
    if signals.off_grid > ON_GRID:
        return "samples are interpolated, which takes out noise"
    return None


def _deviations(problem: Problem) -> Array:
    """Deviations (n,) of white noise of the positions, by what lies above the low-pass."""
    settings, signals = problem.settings, problem.signals
    cutoff_hz = settings.cutoff_hz
    assert cutoff_hz is not None
    smooth = problem.motion.between(settings.start, settings.stop, cutoff_hz).q
    above = np.abs(signals.q[settings.start : settings.stop] - smooth)
    return np.asarray(1.4826 * np.median(above, axis=0) / np.sqrt(1 - 2 * cutoff_hz / signals.sample_rate_hz))


def _with_position(problem: Problem, q: Array) -> Problem:
    signals: Signals = replace(problem.signals, q=q)
    return replace(problem, signals=signals, motion=FilteredMotion(signals))


def _least_squares(problem: Problem, method: Method, ls: LeastSquares) -> Estimate:
    """Least squares of the recording as `ls` was made: of its parameters, columns of load friction apart."""
    system = regression_of_recording(problem).system
    asked = set(map(base_name, ls.estimate.names))
    kept = np.array([k for k, name in enumerate(system.names) if name in asked and system.W[:, k].any()])
    solve = ordinary_least_squares if method == "ols" else weighted_least_squares
    return solve(system.with_columns(kept))
