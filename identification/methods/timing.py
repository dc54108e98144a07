"""The lag of the torque: the known value is corrected before the passes, the one estimated by the instruments after them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Estimate, Intervals, System, intervals_from
from ..regression import KnownLag
from ..simulation import ClosedLoops, Instruments
from ..trust import Lag, combined_lag, lag_columns, lag_moves, lags_in
from .fit import Pass
from .system import StackedSystem

# The torque is corrected and the lag estimated again: the column is of first order only, not exact for many samples.
MAX_LAG_PASSES = 4
MAX_LAST_LAG = 0.25  # samples; the passes end below it
MIN_MOVE = 0.1  # deviations of a parameter: a lag that moves less is not worth another pass over long recordings

Solve = Callable[[Instruments, System], Estimate]


def lag_groups(observed: StackedSystem) -> list[list[int]]:
    """Places of recordings with a common lag: those of the same effort object, timing and rate."""
    groups: dict[object, list[int]] = {}
    for k, one in enumerate(observed.observations):
        signals, known = one.problem.signals, one.problem.settings.known_lag
        key = (*signals.lag_group, known.sd_s == 0.0 and known.value_s)
        groups.setdefault(key, []).append(k)
    return list(groups.values())


def known_lags(observed: StackedSystem) -> list[KnownLag]:
    """The known lag of each group of recordings: their mean, with the smallest deviation."""
    found = []
    for group in lag_groups(observed):
        each = [observed.observations[k].known_lag for k in group]
        best = min(each, key=lambda known: known.sd_s)
        found.append(replace(best, value_s=float(np.mean([known.value_s for known in each]))))
    return found


def correct_known_lags(observed: StackedSystem) -> StackedSystem:
    """The recordings with torques corrected by their known lags."""
    return _with_lags(observed, [known.value_s for known in known_lags(observed)])


def _with_lags(observed: StackedSystem, values_s: Sequence[float]) -> StackedSystem:
    by_place = {k: value for group, value in zip(lag_groups(observed), values_s, strict=True) for k in group}
    return observed.corrected([by_place[k] for k in range(len(by_place))])


def correct_lags(
    observed: StackedSystem, best: Pass, solve: Solve, lab_of: Callable[[StackedSystem], ClosedLoops]
) -> tuple[StackedSystem, Pass, tuple[StackedSystem, Pass] | None]:
    """The recordings corrected by the lags that the instruments of a pass estimate, and the pass solved again.

    For long recordings also their beginning, which has rows, and its pass.
    """
    if not observed.regression.reduced:
        return *_estimate_lags(observed, best, solve), None
    span = observed.on_span()
    lab, beta = lab_of(span), best.estimate.values_of(observed.parameters.names)
    z = lab.instruments(beta, best.covariance)
    own = replace(best, z=z, estimate=solve(z, span.along(z)), replicas=lab.replicas(beta, best.covariance))
    span, own = _estimate_lags(span, own, solve)
    lags = lags_of_all(observed, best.estimate, span.lags, own.estimate)
    now = [observed.observations[group[0]].problem.settings.torque_lag_s for group in lag_groups(observed)]
    change = [abs(lag.value_s - at) / max(lag.sd_s, 1e-12) for lag, at in zip(lags, now, strict=True)]
    if any((deviations * lag.moved > MIN_MOVE).any() for deviations, lag in zip(change, lags, strict=True)):
        observed = _with_lags(observed, [lag.value_s for lag in lags])
        z = lab_of(observed).instruments(best.z.beta, best.asked)
        best = replace(best, z=z, estimate=solve(z, observed.along(z)))
    return replace(observed, lags=lags), best, (replace(span, lags=lags), own)


def _estimate_lags(observed: StackedSystem, best: Pass, solve: Solve) -> tuple[StackedSystem, Pass]:
    """Recordings and pass with torques corrected by their lags, which are estimated if the reference is recorded."""
    z, estimate, reason = best.z, best.estimate, _reason_against(observed, best)
    groups, known, system = lag_groups(observed), known_lags(observed), observed.along(z)
    found: list[tuple[float, float, float] | None] = [None] * len(groups)
    for _ in range(MAX_LAG_PASSES if reason is None else 0):
        try:
            steps, sd, reach = lags_in(observed.simulated(best.replicas), groups, system, z.Z, estimate)
        except IdentificationError:
            break
        now = [observed.observations[group[0]].problem.settings.torque_lag_s for group in groups]
        found = [(float(at + step), float(s), reach) for at, step, s in zip(now, steps, sd, strict=True)]
        values = [combined_lag(prior, data).value_s for prior, data in zip(known, found, strict=True)]
        observed = _with_lags(observed, values).about(z)
        system = observed.along(z)
        estimate = solve(z, system)
        fs = observed.problem.signals.sample_rate_hz
        if max(abs(value - at) for value, at in zip(values, now, strict=True)) * fs < MAX_LAST_LAG:
            break
    lags = [combined_lag(prior, data) for prior, data in zip(known, found, strict=True)]
    observed = observed.about(z)
    moves = lag_moves(observed.regression, lag_columns(observed.observations, groups, estimate), estimate)
    return replace(observed, lags=_named(observed, lags, moves)), replace(best, estimate=estimate)


def _reason_against(observed: StackedSystem, best: Pass) -> str | None:
    """Why the lag cannot be estimated by the instruments; None if it can."""
    if any(one.problem.signals.q_ref is None for one in observed.observations):
        return "the reference is not recorded"
    if any(one.motion is None for one in best.replicas):
        return "the robot cannot be simulated with the estimate"
    return None


def lags_of_ls(observed: StackedSystem, estimate: Estimate) -> tuple[Lag, ...]:
    """The known lags and the moves of least squares by them; least squares cannot estimate lags."""
    lags = [combined_lag(known, None) for known in known_lags(observed)]
    columns = lag_columns(observed.observations, lag_groups(observed), estimate)
    return _named(observed, lags, lag_moves(observed.regression, columns, estimate))


def lags_of_all(
    observed: StackedSystem, estimate: Estimate, of_beginning: tuple[Lag, ...], beginning: Estimate
) -> tuple[Lag, ...]:
    """Lags of all groups of long recordings: estimated from the beginning for the first, known values for the others.

    The moves of the parameters are those of the `beginning`, zero for a friction term that it leaves out.
    """
    (first,), found = of_beginning, []
    by_name = dict(zip(beginning.names, first.moved / max(first.sd_s, 1e-12), strict=True))
    moves = np.array([by_name.get(name, 0.0) for name in estimate.names])
    for group, known in zip(lag_groups(observed), known_lags(observed), strict=True):
        lag = first if 0 in group else combined_lag(known, None)
        names = tuple(observed.observations[k].problem.signals.recording for k in group)
        found.append(replace(lag, moved=moves * lag.sd_s, recordings=names))
    return tuple(found)


def _named(observed: StackedSystem, lags: Sequence[Lag], moves: Array) -> tuple[Lag, ...]:
    """The lags with their recordings, and with the moves by one deviation; `moves` (b, K) is d beta / d lag, per s."""
    found = []
    for lag, group, move in zip(lags, lag_groups(observed), moves.T, strict=True):
        replayed = next((x for k in group if (x := observed.observations[k].replay_lag) is not None), None)
        delay = None
        if replayed is not None and lag.found is not None:
            delay = (replayed.value_s - lag.found[0], lag.reach * lag.found[1])
        names = tuple(observed.observations[k].problem.signals.recording for k in group)
        found.append(replace(lag, delay_s=delay, moved=lag.sd_s * np.abs(move), recordings=names))
    return tuple(found)


def add_lag_variance(estimate: Estimate, found: Intervals, lags: Sequence[Lag]) -> Intervals:
    """Intervals that include the deviations of the lags."""
    return intervals_from(estimate, np.hypot.reduce([found.sigma, *(lag.moved for lag in lags)]), found.freedom)
