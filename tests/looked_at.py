"""A fit together with the evidence that its tests looked at."""

import pytest

import identification.methods.assess as assess
import identification.regression.system as regression_system
from identification.data import Signals
from identification.methods import Fit, identify
from identification.regression import Overrides
from identification.trust import FitData


def looked_at(method: str, signals: Signals, *, long: bool = False, **overrides) -> tuple[Fit, FitData]:
    """`long`: as of a recording whose rows are not held, in short blocks."""
    seen: list[FitData] = []
    with pytest.MonkeyPatch.context() as patch:
        made = assess.trust_in
        patch.setattr(assess, "trust_in", lambda evidence: seen.append(evidence) or made(evidence))
        if long:
            patch.setattr(regression_system, "_MAX_NUMBERS", 100)
            patch.setattr("identification.regression.problem._SERIES_BLOCK", 60_000)
        fit = identify(signals, Overrides(**overrides), method=method)
    return fit, seen[-1]
