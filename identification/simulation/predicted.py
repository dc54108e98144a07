"""The motion that the recorded reference predicts: instruments that need no control law
and no simulated robot.

The error q - r of a controlled robot is gravity, inertia and friction through its unknown loop. It
is regressed on what these are made of, of the reference alone: 1; sin and cos of the joints' angles
and of sums of consecutive ones; dr, ddr; friction, tanh(dr / 5 % of its peak); dr^3; each also
late, which stands for the loop's lags. q^ = r + that has no noise of the position, so instruments
along it are exogenous by construction. What sticks is not predicted: there they are less efficient.
"""

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from acquisition.files import allocate, release_pages

from ..arrays import Array
from ..estimation import r_factor
from ..regression import FilteredMotion, Problem, differentiate, lowpass_reach, rule_cutoff_hz

DELAYS_S = (0.0, 0.02, 0.05, 0.1)
SMOOTH = 0.05  # of the peak speed
MIN_SINGULAR = 1e-6  # of columns of norm 1
MOST_SAMPLES = 50_000  # of the regression, evenly spaced
DESIGN_SAMPLES = 10_000  # whose columns are in memory
EDGE = 2  # samples to each side of an acceleration


# of each motion, by span
_made: WeakKeyDictionary[FilteredMotion, dict[tuple[int, int], FilteredMotion]] = (
    WeakKeyDictionary()
)


def predicted_motion(problem: Problem) -> FilteredMotion:
    """Return the motion that the reference predicts, made once for its span; the measured one where
    no reference is recorded.
    """
    signals, span = problem.signals, (problem.settings.start, problem.settings.stop)
    if signals.q_ref is None:
        return problem.motion
    made = _made.setdefault(problem.motion, {})
    if span not in made:
        predicted = _predicted_positions(signals.q, signals.q_ref, problem, span)
        made[span] = FilteredMotion(signals, predicted)
    return made[span]


def _predicted_positions(q: Array, r: Array, problem: Problem, span: tuple[int, int]) -> Array:
    """q^ (N, n) at all samples of a recording, by the errors within its span and the
    reach of the low-pass.
    """
    fs, (N, n), found = problem.signals.sample_rate_hz, r.shape, allocate(r.shape)
    reach, late = (
        lowpass_reach(rule_cutoff_hz(problem.signals), fs),
        [round(delay_s * fs) for delay_s in DELAYS_S],
    )
    start, stop = max(0, span[0] - reach), min(N, span[1] + reach)
    every = -(-(stop - start) // MOST_SAMPLES)
    peak = np.abs(differentiate(r[start:stop:every], fs / every)).max(axis=0)

    def columns(at: NDArray[np.intp]) -> Array:  # (K, p) at samples (K,), in order
        low = max(0, at[0] - late[-1] - EDGE)
        now = _terms(r[low : at[-1] + 1 + EDGE], peak, fs)
        return np.concatenate(
            [np.ones((len(at), 1)), *(now[np.maximum(at - d, 0) - low] for d in late)], axis=1
        )

    R, block = (
        np.zeros((0, columns(np.array([start])).shape[1] + n)),
        max(1, DESIGN_SAMPLES // every) * every,
    )
    for at in (np.arange(a, min(stop, a + block), every) for a in range(start, stop, block)):
        R = r_factor(np.concatenate([R, np.c_[columns(at), q[at] - r[at]]]))
    size = np.maximum(np.linalg.norm(R[:, :-n], axis=0), np.finfo(float).tiny)
    effects = np.linalg.lstsq(R[:, :-n] / size, R[:, -n:], rcond=MIN_SINGULAR)[0] / size[:, None]
    for at in (np.arange(a, min(N, a + DESIGN_SAMPLES)) for a in range(0, N, DESIGN_SAMPLES)):
        found[at] = r[at] + columns(at) @ effects
        for x in (q, r, found):
            release_pages(x)
    return found


def _terms(r: Array, peak: Array, sample_rate_hz: float) -> Array:
    """What the error is made of, (K, p), of a reference (K, n) with peak speeds (n,)."""
    dr, n = differentiate(r, sample_rate_hz), r.shape[1]
    sums = np.stack([r[:, i:j].sum(axis=1) for i in range(n) for j in range(i + 1, n + 1)], axis=1)
    ddr, friction = (
        differentiate(dr, sample_rate_hz),
        np.tanh(dr / np.maximum(SMOOTH * peak, np.finfo(float).tiny)),
    )
    return np.concatenate([np.sin(sums), np.cos(sums), dr, ddr, friction, dr**3], axis=1)
