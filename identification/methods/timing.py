"""The lag of the torque in a fit: what is known of it is corrected before, what the instruments find of it after the passes."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Estimate, Intervals, intervals_from
from ..replica import PassInstruments, Replica
from ..trust import Lag, combined_lag, lag_columns, lag_moves, lags_in
from .recordings import Observed

LAG_PASSES = (
    4  # of correcting the torque and looking again: a lag of many samples is not quite the column of its first order
)
NEAR = 0.25  # samples that the last of them may find


def lags_along(
    observed: Observed,
    z: PassInstruments,
    replicas: Sequence[Replica],
    solve: Callable[[PassInstruments, Observed], Estimate],
) -> tuple[Observed, Estimate, tuple[Lag, ...]]:
    """The recordings with their torques corrected by their lags, found along instruments where the reference is recorded.

    Parameters
    ----------
    observed, z : the recordings, and the instruments of the pass that is returned.
    replicas : the robot simulated with its estimate.
    solve : the estimate along instruments.

    Returns
    -------
    The recordings, the estimate along the same instruments, and the lags with what they move.
    """
    groups, known = observed.lag_groups, observed.known_lags
    estimate, why = solve(z, observed), _not_looked_at(observed, replicas)
    found: list[tuple[float, float, float] | None] = [None] * len(groups)
    for _ in range(LAG_PASSES if why is None else 0):
        parts = [
            replace(part, simulated=one.simulated.motion, decimation=one.simulated.decimation)
            for part, one in zip(observed.evidence, replicas, strict=True)
        ]
        try:
            steps, sd, reach = lags_in(parts, groups, *observed.along(z), estimate)
        except IdentificationError as error:
            why = str(error)
            break
        now = [observed.observations[group[0]].problem.settings.torque_lag_s for group in groups]
        found = [(float(at + step), float(s), reach) for at, step, s in zip(now, steps, sd, strict=True)]
        lags = [combined_lag(prior, data, "") for prior, data in zip(known, found, strict=True)]
        observed = observed.with_lags([lag.value_s for lag in lags])
        estimate = solve(z, observed)
        fs = observed.problem.signals.sample_rate_hz
        if max(abs(lag.value_s - at) for lag, at in zip(lags, now, strict=True)) * fs < NEAR:
            break
    lags = [combined_lag(prior, data, why or "") for prior, data in zip(known, found, strict=True)]
    columns = lag_columns(observed.evidence, groups, estimate)
    about = observed.about(z)
    return observed, estimate, _with_moves(observed, lags, lag_moves(about.regression, z.used, columns, estimate))


def _not_looked_at(observed: Observed, replicas: Sequence[Replica]) -> str | None:
    """Why the lag is not found along the instruments, None where it is."""
    if any(one.problem.signals.q_ref is None for one in observed.observations):
        return "the reference is not recorded"
    if any(one.simulated.motion is None for one in replicas):
        return "the robot cannot be simulated with the estimate"
    return None


def lags_of_ls(observed: Observed, estimate: Estimate) -> tuple[Lag, ...]:
    """What is known of the lags, and what they move in an estimate by least squares, which cannot find them."""
    lags = [combined_lag(known, None, "least squares cannot tell it") for known in observed.known_lags]
    columns = lag_columns(observed.evidence, observed.lag_groups, estimate)
    used = observed.regression.fast.T.reshape(-1).astype(float)
    return _with_moves(observed, lags, lag_moves(observed.regression, used, columns, estimate))


def _with_moves(observed: Observed, lags: Sequence[Lag], moves: Array) -> tuple[Lag, ...]:
    """The lags, named, and what one deviation of each moves; `moves` (b, K) is d beta / d lag, per s."""
    found = []
    for lag, group, move in zip(lags, observed.lag_groups, moves.T, strict=True):
        delays = [observed.observations[k].replay_lag for k in group]
        replayed, delay = next((one for one in delays if one is not None), None), None
        if replayed is not None and lag.found is not None:
            delay = (replayed.value_s - lag.found[0], lag.reach * lag.found[1])
        names = tuple(observed.observations[k].problem.signals.recording for k in group)
        found.append(replace(lag, delay_s=delay, moved=lag.sd_s * np.abs(move), recordings=names))
    return tuple(found)


def counted(estimate: Estimate, found: Intervals, lags: Sequence[Lag]) -> tuple[Intervals, tuple[Lag, ...]]:
    """Intervals with the deviations of the lags counted; and the lags, what they move in deviations of the intervals before."""
    moved = [np.asarray(lag.moved) for lag in lags]
    sigma = np.hypot.reduce([found.sigma, *moved])
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = [np.nan_to_num(own / found.sigma, posinf=np.inf) for own in moved]
    told = tuple(replace(lag, moved=share) for lag, share in zip(lags, shares, strict=True))
    return intervals_from(estimate, sigma, found.freedom), told
