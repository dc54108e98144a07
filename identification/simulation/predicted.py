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

from acquisition.files import allocate, release_pages

from ..arrays import Array, Ints
from ..data import Signals
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
    signals, start, stop = problem.signals, problem.settings.start, problem.settings.stop
    if signals.q_ref is None:
        return problem.motion
    made = _made.setdefault(problem.motion, {})
    if (start, stop) not in made:
        reach = lowpass_reach(rule_cutoff_hz(signals), signals.sample_rate_hz)
        within = range(max(0, start - reach), min(len(signals.q), stop + reach))
        made[start, stop] = FilteredMotion(signals, _positions(signals, signals.q_ref, within))
    return made[start, stop]


def _positions(signals: Signals, r: Array, within: range) -> Array:
    """q^ (N, n) at all samples of a recording, by the errors of the samples `within`."""
    (N, n), q, fs, found = r.shape, signals.q, signals.sample_rate_hz, allocate(r.shape)
    late = [round(delay_s * fs) for delay_s in DELAYS_S]
    every = -(-len(within) // MOST_SAMPLES)
    used = np.array(within[::every])
    peak = np.abs(differentiate(r[used], fs / every)).max(axis=0)

    def columns(at: Ints) -> Array:  # (K, p) at samples (K,), in order
        low = max(0, at[0] - late[-1] - EDGE)
        now = _terms(r[low : at[-1] + 1 + EDGE], peak, fs)
        return np.concatenate(
            [np.ones((len(at), 1)), *(now[np.maximum(at - d, 0) - low] for d in late)], axis=1
        )

    few = max(1, DESIGN_SAMPLES // every)  # of that many samples the terms are made
    blocks = (used[k : k + few] for k in range(0, len(used), few))
    R = r_factor(np.concatenate([r_factor(np.c_[columns(at), q[at] - r[at]]) for at in blocks]))
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
    friction = np.tanh(dr / np.maximum(SMOOTH * peak, np.finfo(float).tiny))
    ddr = differentiate(dr, sample_rate_hz)
    return np.concatenate([np.sin(sums), np.cos(sums), dr, ddr, friction, dr**3], axis=1)
