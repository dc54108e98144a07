"""A fit together with the evidence that its tests looked at."""

import pytest

from identification.data import Signals
from identification.methods import Fit, identify
from identification.regression import Overrides
from identification.trust import FitData


def looked_at(
    method: str, signals: Signals, *, long: bool = False, **overrides
) -> tuple[Fit, FitData]:
    """`long`: as of a recording whose rows are not held, in short blocks."""
    with pytest.MonkeyPatch.context() as patch:
        if long:
            patch.setattr("identification.regression.equations._MAX_NUMBERS", 100)
            patch.setattr("identification.regression.problem._SERIES_BLOCK", 60_000)
        fit = identify(signals, Overrides(**overrides), method=method)
    return fit, fit.data
