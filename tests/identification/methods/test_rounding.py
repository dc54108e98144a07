"""An estimate does not depend on the last bit of the samples: no weight of a joint rests on
columns that are rounding.
"""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY
from fits_of_records import cut, signals_of

from identification.methods import solve
from identification.regression import Overrides


@pytest.mark.parametrize(("name", "method"), [("emps", "iv"), ("scara", "iv"), ("tx40", "wls")])
def test_last_digit_changes_move_no_estimate(name, method):
    rng, signals = np.random.default_rng(0), signals_of(REPLAY / name / "session.mcap")
    signals = cut(signals, len(signals.q) // 2)
    series = ((key, getattr(signals, key)) for key in ("q", "q_ref", "effort"))
    moved = {key: x + rng.integers(-1, 2, x.shape) * np.spacing(np.abs(x)) for key, x in series}
    first, second = (
        solve(one, Overrides(), method=method).inputs.estimate
        for one in (signals, replace(signals, **moved))
    )
    # 1e-8 where links are computed at a stride: rounding of accelerations folds.
    assert (np.abs(first.beta - second.beta) < 3e-8 * first.sigma).all()
