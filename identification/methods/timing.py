"""The lag of the torque: the known value is corrected before the passes; in each pass that has
instruments it is estimated.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..errors import NoFitError
from ..estimation import (
    Estimate,
    System,
    by_joint,
    instrumental_variables,
    intervals_of,
    stacked,
)
from ..regression import NOTHING, KnownLag, Rows
from ..simulation import Simulated
from ..trust import Lag, combined_lag, moves_of
from .equations import Equations, refuse_standing_joints

# samples; the column of the lag is of first order, not exact for many
MAX_LAST_LAG = 0.25


def lag_groups(equations: Equations) -> list[list[int]]:
    """Places of recordings with a common lag: those of the same effort object, timing and rate."""
    groups: dict[object, list[int]] = {}
    for k, problem in enumerate(equations.problems):
        signals, known = problem.signals, problem.settings.known_lag
        groups.setdefault((*signals.lag_group, known.sd_s == 0.0 and known.value_s), []).append(k)
    return list(groups.values())


def known_lags(equations: Equations, groups: Sequence[Sequence[int]]) -> list[KnownLag]:
    """The known lag of each group of recordings: their mean, with the smallest deviation."""
    found = []
    for group in groups:
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
    until it finds others. Raises `NoFitError` where a joint stands in all of them.
    """
    groups = lag_groups(equations)
    known = [combined_lag(known, None) for known in known_lags(equations, groups)]
    found = with_lags(equations, groups, known)
    refuse_standing_joints(found)
    return found


def with_lags(
    equations: Equations, groups: Sequence[Sequence[int]], lags: Sequence[Lag]
) -> Equations:
    """The recordings with torques corrected by the lags of their groups."""
    of = {k: lag.value_s for group, lag in zip(groups, lags, strict=True) for k in group}
    return equations.corrected([of[k] for k in range(len(of))], tuple(lags))


def with_lags_found(
    equations: Equations, z: Sequence[Simulated], *, first: bool
) -> tuple[Equations, bool]:
    """The recordings with torques corrected by the lags that the rows of instruments find
    together with what is known, and whether these lags have settled: not in the `first` pass, as
    the residuals of least squares, by which its rows are whitened, have the lag in them.

    Unchanged where instruments have no such rows, or the reference is not recorded.
    """
    signals, rows = (
        [problem.signals for problem in equations.problems],
        [x for one in z if (x := one.rows)],
    )
    late = [one.late for one in rows if one.late is not None]
    if any(one.q_ref is None for one in signals) or len(late) < len(signals):
        return equations, True
    groups, priors = lag_groups(equations), [lag.prior for lag in equations.lags]
    now = np.array([rows[group[0]].torque_lag_s for group in groups])
    found: list[tuple[float, float, int] | None] = [None] * len(groups)
    with suppress(NoFitError):  # the rows do not determine them
        steps, sd, freedom = lags_in(equations, late, groups)
        pairs = zip((now + steps).tolist(), sd.tolist(), strict=True)
        found = [(value, deviation, freedom) for value, deviation in pairs]
    lags = [combined_lag(*each) for each in zip(priors, found, strict=True)]
    steps = np.abs([lag.value_s for lag in lags] - now)
    settled = steps.max() * signals[0].sample_rate_hz < MAX_LAST_LAG
    stated = all(prior.stated for prior in priors)
    return with_lags(equations, groups, lags), bool(settled) and (stated or not first)


def lags_in(
    equations: Equations, each: Sequence[tuple[System, Array]], groups: Sequence[Sequence[int]]
) -> tuple[Array, Array, int]:
    """Lags (K,) of the torques in s beside those already corrected, deviations (K,) and their
    degrees of freedom, from the rows of the lag of each recording.

    Raises `NoFitError` where the instruments do not determine the lags.
    """
    systems, Z, K = list[System](), list[Array](), len(groups)
    p = len(equations.names) - len(equations.unknowns.motors)
    names = (*equations.names[:p], *(f"lag {k}" for k in range(K)))
    for k, ((rows, instruments), arm) in enumerate(zip(each, equations.unknowns.arms, strict=True)):
        of = np.array([[float(k in group) for group in groups]])
        J, own = (np.c_[A[:, :-1] @ arm.P[:, :p], A[:, -1:] @ of] for A in (rows.W, instruments))
        systems.append(replace(rows, W=J, names=names))
        Z.append(own)
    system, order = stacked(systems), by_joint(systems)
    size = np.sqrt(
        np.bincount(system.joint_of_row, system.Y**2, len(system.rows)) / np.maximum(1, system.rows)
    )
    if not size.max() > 0:
        raise NoFitError("the fit is exact")
    found = instrumental_variables(
        system, np.concatenate(Z)[order], 1 / np.maximum(size, 1e-9 * size.max())
    )
    within = intervals_of(system, found)
    return found.beta[p:], within.sigma[p:], within.freedom


def lags_of(equations: Equations, rows: Rows, estimate: Estimate) -> tuple[Lag, ...]:
    """The lags with their recordings, and the moves of an estimate by one deviation of each: the
    last of the further columns is the rate of the torque.
    """
    groups, recording = lag_groups(equations), rows.system.recording
    columns = [-rows.C[:, -1] * np.isin(recording, group) for group in groups]
    moves, found = moves_of(rows.system, np.stack(columns, axis=1), estimate), []
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
