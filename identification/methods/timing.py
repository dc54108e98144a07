"""The lag of the torque in a fit: what is known of it is corrected before, what the instruments find of it after the passes."""

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

# Of correcting the torque and looking again: a lag of many samples is not quite the column of its first order.
LAG_PASSES = 4
NEAR = 0.25  # samples that the last of them may find
MOVES = 0.1  # deviations of a parameter: of long recordings a lag that moves less is not worth another pass over them

Solve = Callable[[Instruments, System], Estimate]


def lag_groups(observed: StackedSystem) -> list[list[int]]:
    """Places of recordings whose torques have one lag: those of one effort object, timing and rate."""
    groups: dict[object, list[int]] = {}
    for k, one in enumerate(observed.observations):
        signals, known = one.problem.signals, one.problem.settings.known_lag
        key = (signals.effort_timing, signals.provenance, signals.sample_rate_hz, known.sd_s == 0.0 and known.value_s)
        groups.setdefault(key, []).append(k)
    return list(groups.values())


def known_lags(observed: StackedSystem) -> list[KnownLag]:
    """What is known of the lag of each group of recordings: the mean of theirs, with the deviation of the best known."""
    found = []
    for group in lag_groups(observed):
        each = [observed.observations[k].known_lag for k in group]
        best = min(each, key=lambda known: known.sd_s)
        found.append(replace(best, value_s=float(np.mean([known.value_s for known in each]))))
    return found


def correct_known_lags(observed: StackedSystem) -> StackedSystem:
    """The recordings with their torques corrected by what is known of their lags."""
    return _with_lags(observed, [known.value_s for known in known_lags(observed)])


def _with_lags(observed: StackedSystem, values_s: Sequence[float]) -> StackedSystem:
    by_place = {k: value for group, value in zip(lag_groups(observed), values_s, strict=True) for k in group}
    return observed.corrected([by_place[k] for k in range(len(by_place))])


def timed(
    observed: StackedSystem, best: Pass, solve: Solve, lab_of: Callable[[StackedSystem], ClosedLoops]
) -> tuple[StackedSystem, Pass, tuple[StackedSystem, Pass] | None]:
    """The recordings corrected by the lags of their torques, which the instruments of a pass find, and the pass in that time.

    Of long recordings also their beginning, which has rows, and the pass there.
    """
    if not observed.regression.reduced:
        return *_in_time(observed, best, solve), None
    span, weights = observed.on_span(), best.estimate.weights
    lab, beta = lab_of(span), best.estimate.values_of(observed.parameters.names)
    z = lab.instruments(beta, best.covariance, weights)
    own = replace(best, z=z, estimate=solve(z, span.along(z)), replicas=lab.replicas(beta, best.covariance))
    span, own = _in_time(span, own, solve)
    lags = over_all(observed, best.estimate, span.lags)
    now = [observed.observations[group[0]].problem.settings.torque_lag_s for group in lag_groups(observed)]
    off = [abs(lag.value_s - at) / max(lag.sd_s, 1e-12) for lag, at in zip(lags, now, strict=True)]
    if any((share * lag.moved > MOVES).any() for share, lag in zip(off, lags, strict=True)):
        observed = _with_lags(observed, [lag.value_s for lag in lags])
        z = lab_of(observed).instruments(best.z.beta, best.asked, weights, rows=best.z.moving_rows)
        best = replace(best, z=z, estimate=solve(z, observed.along(z)))
    return replace(observed, lags=lags), best, (replace(span, lags=lags), own)


def _in_time(observed: StackedSystem, best: Pass, solve: Solve) -> tuple[StackedSystem, Pass]:
    """The recordings and a pass with the torques corrected by their lags, found where the reference is recorded."""
    z, estimate, why = best.z, best.estimate, _not_looked_at(observed, best)
    groups, known, system = lag_groups(observed), known_lags(observed), observed.along(z)
    found: list[tuple[float, float, float] | None] = [None] * len(groups)
    for _ in range(LAG_PASSES if why is None else 0):
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
        if max(abs(value - at) for value, at in zip(values, now, strict=True)) * fs < NEAR:
            break
    lags = [combined_lag(prior, data) for prior, data in zip(known, found, strict=True)]
    observed = observed.about(z)
    moves = lag_moves(observed.regression, z.used, lag_columns(observed.observations, groups, estimate), estimate)
    return replace(observed, lags=_named(observed, lags, moves)), replace(best, estimate=estimate)


def _not_looked_at(observed: StackedSystem, best: Pass) -> str | None:
    """Why the lag is not found along the instruments, None where it is."""
    if any(one.problem.signals.q_ref is None for one in observed.observations):
        return "the reference is not recorded"
    if any(one.motion is None for one in best.replicas):
        return "the robot cannot be simulated with the estimate"
    return None


def lags_of_ls(observed: StackedSystem, estimate: Estimate) -> tuple[Lag, ...]:
    """What is known of the lags, and what they move in least squares, which cannot find them."""
    lags = [combined_lag(known, None) for known in known_lags(observed)]
    columns = lag_columns(observed.observations, lag_groups(observed), estimate)
    used = observed.regression.fast.T.reshape(-1).astype(float)
    return _named(observed, lags, lag_moves(observed.regression, used, columns, estimate))


def over_all(observed: StackedSystem, estimate: Estimate, of_beginning: tuple[Lag, ...]) -> tuple[Lag, ...]:
    """Lags of all groups of long recordings: of the first one's what its beginning tells, of others what is known.

    What a lag moves is that of the beginning.
    """
    (first,), found = of_beginning, []
    for group, known in zip(lag_groups(observed), known_lags(observed), strict=True):
        lag = first if 0 in group else combined_lag(known, None)
        moved = first.moved / max(first.sd_s, 1e-12) * lag.sd_s
        names = tuple(observed.observations[k].problem.signals.recording for k in group)
        found.append(replace(lag, moved=moved[: len(estimate.names)], recordings=names))
    return tuple(found)


def _named(observed: StackedSystem, lags: Sequence[Lag], moves: Array) -> tuple[Lag, ...]:
    """The lags, named, with what one deviation of each moves; `moves` (b, K) is d beta / d lag, per s."""
    found = []
    for lag, group, move in zip(lags, lag_groups(observed), moves.T, strict=True):
        replayed = next((x for k in group if (x := observed.observations[k].replay_lag) is not None), None)
        delay = None
        if replayed is not None and lag.found is not None:
            delay = (replayed.value_s - lag.found[0], lag.reach * lag.found[1])
        names = tuple(observed.observations[k].problem.signals.recording for k in group)
        found.append(replace(lag, delay_s=delay, moved=lag.sd_s * np.abs(move), recordings=names))
    return tuple(found)


def counted(estimate: Estimate, found: Intervals, lags: Sequence[Lag]) -> Intervals:
    """Intervals with the deviations of the lags counted."""
    return intervals_from(estimate, np.hypot.reduce([found.sigma, *(lag.moved for lag in lags)]), found.freedom)
