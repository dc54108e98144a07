"""The test of least squares for position noise, by simulation and extrapolation."""

from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..data import ON_GRID
from ..errors import NoFitError
from ..estimation import Estimate
from ..regression import (
    FilteredMotion,
    Problem,
    equation_alone,
    fast_size,
    rows_of_recording,
    sample_weights,
)
from ..report import FTest, Method, TrustLine, base_name
from ..trust import POSITION_NOISE
from .passes import Pass
from .start import solver_of

CORRELATIONS = np.linspace(0.0, 0.95, 39)  # of the noise from sample to sample that are tried
BANDS = 12  # of frequencies above the low-pass, in which shapes are compared
MAX_CUTOFF = 0.3  # of the sample rate: above it too little of the noise is free of motion
# in half-widths and in percent of the value, both: of a wide interval half of it is no small error
MAX_BIAS = ((1.0, 1.0), (0.5, 5.0))


def position_noise_line(
    problem: Problem, method: Method, ls: Pass, essential: FTest, *, alone: bool
) -> TrustLine | None:
    """Bias of least squares by position noise, in half-widths.

    Simulation and extrapolation: Cook, Stefanski, Simulation-extrapolation estimation in parametric
    measurement error models, JASA 89 (1994). Noise with the spectrum found above the low-pass is
    added over the whole band, with both signs; the mean of the two moves is, to first order, the
    bias by the noise within the band.

    `alone`: `ls` has only this recording, without load friction.
    """
    settings, reason, asked = problem.settings, _reason_against(problem), ls.estimate
    if reason is not None:
        return POSITION_NOISE.judge({"no noise": True}, reason=reason)
    assert settings.cutoff_hz is not None
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
        return POSITION_NOISE.judge({"no noise": True}, reason=error.args[0])
    names = tuple(x for x in essential.names if x in plain.names and x in asked.names)
    indices = np.array([asked.names.index(name) for name in names])
    beta, half = plain.values_of(names), ls.intervals.half[indices]
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
    """Why the noise cannot be estimated; None if it can."""
    settings, signals = problem.settings, problem.signals
    if settings.cutoff_hz is None:
        return POSITION_NOISE.part("no low-pass")
    if settings.cutoff_hz > MAX_CUTOFF * signals.sample_rate_hz:
        return POSITION_NOISE.part("wide", cutoff_hz=settings.cutoff_hz)
    return POSITION_NOISE.part("interpolated") if signals.off_grid > ON_GRID else None


def _noise_like(problem: Problem) -> Array:
    """Noise (N, n) with the spectrum of the positions well above low-pass and motion: white, or
    the AR(1) that fits it.

    Rounding and most encoders give white noise. Noise that falls with frequency is larger below
    the low-pass than above.
    """
    settings, fs, rng = problem.settings, problem.signals.sample_rate_hz, np.random.default_rng(0)
    q = problem.signals.q[: settings.stop + round(fs)]  # no more than is used
    used, size = q[settings.start : settings.stop], fast_size(len(q))
    frequencies = np.fft.rfftfreq(size)
    above = used - problem.motion.between(settings.start, settings.stop, settings.cutoff_hz).q
    window = np.hanning(len(used))[:, None]
    power = np.abs(np.fft.rfft(above * window, size, axis=0)) ** 2 / np.sum(window**2)
    cosine = np.cos(2 * np.pi * frequencies)
    seen = np.flatnonzero(frequencies > max(1.5 * (settings.cutoff_hz or 0.0) / fs, 1 / 8))
    bands = [band for band in np.array_split(seen, BANDS) if len(band)]
    # of an exponential distribution
    level = np.array([np.median(power[band], axis=0) for band in bands]) / np.log(2)
    phi, of_band = CORRELATIONS[:, None], np.array([cosine[band].mean() for band in bands])
    shapes = 1 / (1 - 2 * phi * of_band + phi**2)
    # (correlations, bands, n)
    off = np.log(np.maximum(level, 1e-300))[None] - np.log(shapes)[:, :, None]
    best = off.std(axis=1).argmin(axis=0)
    scale = np.exp(0.5 * off.mean(axis=1)[best, np.arange(q.shape[1])])
    white = np.fft.rfft(rng.standard_normal((size, q.shape[1])), axis=0) * scale
    turns = np.exp(-2j * np.pi * frequencies)[:, None]
    noise = np.fft.irfft(white / (1 - CORRELATIONS[best] * turns), size, axis=0)
    return np.asarray(noise[: len(q)])


def _with_noise(problem: Problem, noise: Array) -> Problem:
    """With the weights of samples as they are."""
    q = np.array(problem.signals.q)
    q[: len(noise)] += noise
    noisy = replace(problem, motion=FilteredMotion(problem.signals, q))
    sample_weights(noisy, sample_weights(problem))
    return noisy


def _least_squares(problem: Problem, method: Method, of: Estimate) -> Estimate:
    """Least squares of the recording with the parameters `of` another, without load friction."""
    system = rows_of_recording(*equation_alone(problem)).system
    asked = set(map(base_name, of.names))
    columns = np.array(
        [k for k, name in enumerate(system.names) if name in asked and system.W[:, k].any()]
    )
    return solver_of(method)(system.with_columns(columns))
