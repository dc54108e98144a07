"""A fit together with the evidence that its tests looked at."""

import pytest

from identification.data import Signals
from identification.methods import Fit, identify
from identification.regression import Overrides
from identification.trust import FitData

LIMITS = {
    "spans": {},
    "blocks": {"identification.regression.problem._SERIES_BLOCK": 60_000},
    "instants": {"identification.estimation.system.SPANS": 1_000_000},
}


def looked_at(method: str, signals: Signals, by: str = "spans", **overrides) -> tuple[Fit, FitData]:
    """`by`: in short `blocks`, or with rows of `instants` in place of those of spans of time."""
    with pytest.MonkeyPatch.context() as patch:
        for name, limit in LIMITS[by].items():
            patch.setattr(name, limit)
        fit = identify(signals, Overrides(**overrides), method=method)
    return fit, fit.data
