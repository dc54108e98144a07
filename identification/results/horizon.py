"""How far a fit predicts the motion: its direct model, open loop, from measured states."""

import numpy as np

from ..arrays import Array
from ..model import direct_model
from ..regression import Problem
from ..simulation import open_loop

HORIZONS_S = (0.1, 0.5, 1.0)
MOST_STARTS = 20
MAX_STEP_S = 0.001


def errors_ahead(problem: Problem, beta: Array) -> Array | None:
    """Predict the positions of a recording by base parameters (b,) and its recorded torque.

    Returns (2, h, n) the rms over the starts of the error after each of `HORIZONS_S`, and of the
    way moved until then, rad or m; None where the recording is too short, M is not positive, or the
    motion grows beyond bounds.
    """
    s, fs = problem.settings, problem.signals.sample_rate_hz
    ahead = [max(1, round(x * fs)) for x in HORIZONS_S]
    span, measured = ahead[-1] + 1, problem.measured_samples()
    starts = [
        k for k in range(s.start, s.stop - span, max(1, span)) if measured[k : k + span].all()
    ]
    model = direct_model(problem.model, problem.base.standard_parameters(beta))
    fastest, each = np.abs(problem.motion.between(s.start, s.stop, s.cutoff_hz).dq).max(axis=0), []
    for k in starts[:: -(-len(starts) // MOST_STARTS)] if starts else ():
        motion = problem.motion.between(k, k + span, s.cutoff_hz)
        tau = problem.drives(k, k + span, s.torque_lag_s)
        if problem.signals.known_torque is not None:
            tau = tau + problem.signals.known_torque[k : k + span]
        try:
            q = open_loop(model, (motion.q[0], motion.dq[0]), tau, (fs, MAX_STEP_S), fastest)
        except ArithmeticError:
            return None
        each.append((q[ahead] - motion.q[ahead], motion.q[ahead] - motion.q[0]))
    found = np.sqrt(np.mean(np.square(each), axis=0)) if each else np.array(np.inf)
    return found if np.isfinite(found).all() else None
