"""The lag of the recorded torque as known without a fit: by the user, the recording, and the
described control law, which gives the effort at its own instants.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..regression import NOTHING, Lag, Problem
from .found_law import FoundLaw

MAX_LAW_PERCENT = 5.0  # of the effort's variation that a law does not give
DRIVE_DELAY_S = 0.0005  # deviation of the delay from command to torque


def _lag_by_law(problem: Problem, found: FoundLaw | None) -> Lag | None:
    """Return the lag of the torque without an estimate, where the described control law gives the
    effort; drives have loops that a description does not.

    A command acts from its tick to the next one, on average half a period later; the drive's own
    delay is not included.
    """
    if found is None or found.described is None or problem.signals.of_drives:
        return None
    similar = found.residual_percent <= MAX_LAW_PERCENT
    if not similar.any():
        return None
    value_s = float(found.lag_s[similar].mean()) - 0.5 * found.law.period_s
    sd_s = float(np.hypot(found.lag_sd_s[similar].max(), DRIVE_DELAY_S))
    return replace(
        problem.settings.lag, value_s=value_s, sd_s=sd_s, source="the described control law"
    )


def lag_without_fit(group: Sequence[tuple[Problem, FoundLaw | None]]) -> Lag:
    """Return the lag of a group of recordings as known without an estimate, by user, recording and
    law: the mean of theirs, with the smallest deviation.
    """
    each, by_law_s = list[Lag](), None
    for problem, found in group:
        known, by_law = problem.settings.lag, _lag_by_law(problem, found)
        if by_law is not None:
            by_law_s = by_law.value_s if by_law_s is None else by_law_s
            if not known.stated:
                known = by_law if known.source == NOTHING else known.with_other(by_law)
        each.append(known)
    mean_s = float(np.mean([known.value_s for known in each]))
    return replace(min(each, key=lambda known: known.sd_s), value_s=mean_s, by_law_s=by_law_s)
