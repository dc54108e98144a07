"""A fit together with the evidence that its tests looked at."""

import pytest

from identification.data import Signals
from identification.regression import Overrides
from identification.results import Evidence, identify
from identification.trust import TrustInputs

LIMITS = {
    "spans": {"identification.estimation.system.SHORT": 0},
    "instants": {"identification.estimation.system.FINE_SPANS": 1_000_000},
}


def looked_at(
    method: str, signals: Signals, by: str = "spans", **overrides
) -> tuple[Evidence, TrustInputs]:
    """`by`: as a long recording, by `spans` of time, or by `instants`."""
    with pytest.MonkeyPatch.context() as patch:
        for name, limit in LIMITS[by].items():
            patch.setattr(name, limit)
        fit = identify(signals, Overrides(**overrides), method=method)
    return fit, fit.data
