"""Signals and fits of a recording as they come without options, made once for all tests.

Not for a test that patches the method: others would be given its fit.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from identification.data import Signals, load_signals
from identification.methods import Iteration
from identification.regression import Overrides
from identification.regression.filtering import lowpass
from identification.results import Evidence, fit_file, identify_iv, identify_ls
from identification.study import write_signals
from identification.view import draw_fit
from identification.view.panels import Picture


@cache
def signals_of(path: Path) -> Signals:
    return load_signals(path)


def short_recording(path: Path, of: Path, samples: int = 5000) -> Path:
    """Its first samples, for a command that takes any recording."""
    write_signals(path, cut(signals_of(of), samples), source="a part of another")
    return path


@cache
def thinned(path: Path) -> Signals:
    """The recording with a tenth of its samples, low-pass filtered at 200 Hz."""
    whole, rate_hz = signals_of(path), signals_of(path).sample_rate_hz
    thin = {x: lowpass(getattr(whole, x), 200.0, rate_hz)[::10] for x in ("q", "effort")}
    return replace(whole, **thin, t_s=whole.t_s[::10], sample_rate_hz=rate_hz / 10)


def cut(signals: Signals, *rows: int | None) -> Signals:
    """The samples of `slice(*rows)` alone."""
    series = ((x, getattr(signals, x)) for x in ("t_s", "q", "q_ref", "effort", "measured"))
    return replace(signals, **{k: x[slice(*rows)] for k, x in series if x is not None})


@cache
def ls_of(path: Path) -> Evidence:
    return identify_ls(signals_of(path), Overrides())


@cache
def iv_of(path: Path) -> Evidence:
    return identify_iv(signals_of(path), Overrides(), Iteration())


def picture_of(fit: Evidence, **truth: np.ndarray) -> Picture:
    return draw_fit(fit_file(fit), fit.recordings[0], **truth)
