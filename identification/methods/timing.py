"""The lag of the torque: the known value is corrected before the passes; in each pass that has
instruments it is estimated.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..errors import NoFitError
from ..estimation import Estimate, spans_of
from ..regression import NOTHING, KnownLag, Rows
from ..simulation import Simulated
from ..trust import Lag, by_group, combined_lag, lags_in, moves_of, simulated_rates
from .equations import Equations

# The torque is corrected and the lag estimated again: the column is of first order only, not
# exact for many samples.
MAX_LAG_STEPS = 4
MAX_LAST_LAG = 0.25  # samples; the steps end below it


def lag_groups(equations: Equations) -> list[list[int]]:
    """Places of recordings with a common lag: those of the same effort object, timing and rate."""
    groups: dict[object, list[int]] = {}
    for k, problem in enumerate(equations.problems):
        signals, known = problem.signals, problem.settings.known_lag
        groups.setdefault((*signals.lag_group, known.sd_s == 0.0 and known.value_s), []).append(k)
    return list(groups.values())


def known_lags(equations: Equations) -> list[KnownLag]:
    """The known lag of each group of recordings: their mean, with the smallest deviation."""
    found = []
    for group in lag_groups(equations):
        each = [
            _known(equations.problems[k].settings.known_lag, equations.replays[k][1]) for k in group
        ]
        best = min(each, key=lambda known: known.sd_s)
        found.append(replace(best, value_s=float(np.mean([known.value_s for known in each]))))
    return found


def _known(known: KnownLag, replayed: KnownLag | None) -> KnownLag:
    """The lag of a torque as known without an estimate, with the replay of its control law."""
    if known.stated or replayed is None:
        return known
    return replayed if known.source == NOTHING else known.with_other(replayed)


def correct_known_lags(equations: Equations) -> Equations:
    """The recordings with torques corrected by their known lags, which are those of the fit
    until it finds others.
    """
    return with_lags(equations, [combined_lag(known, None) for known in known_lags(equations)])


def with_lags(equations: Equations, lags: Sequence[Lag]) -> Equations:
    """The recordings with torques corrected by the lags of their groups."""
    of = {
        k: lag.value_s
        for group, lag in zip(lag_groups(equations), lags, strict=True)
        for k in group
    }
    return replace(equations.corrected([of[k] for k in range(len(of))]), lags=tuple(lags))


def with_lags_found(
    equations: Equations, x: Array, z: Sequence[Simulated], weights: Array
) -> Equations:
    """The recordings with torques corrected by the lags that instruments `z` about x find
    together with what is known.

    Unchanged where the reference is not recorded; long recordings have the lags of their beginning.
    """
    problems = equations.problems
    signals = [problem.signals for problem in problems]
    if any(one.q_ref is None for one in signals) or equations.reduced:
        return equations
    groups, known = lag_groups(equations), known_lags(equations)
    each = map(simulated_rates, problems, [one.motion for one in z if one.motion])
    rates, fast = zip(*each, strict=True)
    columns = by_group(rates, groups)
    for _ in range(MAX_LAG_STEPS):
        try:
            rows = equations.along(x, z)
            steps, sd, freedom = lags_in(rows, (rows.Z, columns, fast), weights)
        except NoFitError:
            break
        now = [equations.problems[group[0]].settings.torque_lag_s for group in groups]
        found = [
            (float(at + step), float(s), freedom)
            for at, step, s in zip(now, steps, sd, strict=True)
        ]
        lags = [combined_lag(prior, data) for prior, data in zip(known, found, strict=True)]
        equations = with_lags(equations, lags)
        last = max(abs(lag.value_s - at) for lag, at in zip(lags, now, strict=True))
        if last * signals[0].sample_rate_hz < MAX_LAST_LAG:
            break
    return equations


def lags_of(equations: Equations, rows: Rows, estimate: Estimate) -> tuple[Lag, ...]:
    """The lags with their recordings, and the moves of an estimate by one deviation of each: the
    last of the further columns is the rate of the torque.
    """
    groups, n, spans = lag_groups(equations), len(rows.system.rows), rows.system.spans
    parts = spans_of([own.count * own.rows for own in spans])
    rates = [rows.C[:, -1].reshape(n, -1)[:, part] for part in parts]
    moves, found = moves_of(rows.system, by_group(rates, groups), estimate), []
    for lag, group, move in zip(equations.lags, groups, moves.T, strict=True):
        replayed = next((x for k in group if (x := equations.replays[k][1]) is not None), None)
        delay = (
            (replayed.value_s - lag.found[0], lag.reach * lag.found[1])
            if replayed is not None and lag.found is not None
            else None
        )
        names = tuple(equations.problems[k].signals.recording for k in group)
        found.append(replace(lag, delay_s=delay, moved=lag.sd_s * np.abs(move), recordings=names))
    return tuple(found)
