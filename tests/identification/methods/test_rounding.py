"""An estimate does not depend on the last bit of the samples: no weight of a joint rests on columns that are rounding."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY

from identification.data import load_signals
from identification.methods import Iteration, identify_iv, identify_ls
from identification.regression import Overrides


@pytest.mark.parametrize("name", ["emps", "scara", "tx40"])
def test_samples_moved_by_one_unit_in_their_last_place_move_no_estimate(name):
    rng, signals = np.random.default_rng(0), load_signals(REPLAY / name / "session.mcap")

    def moved(x):
        return x + rng.integers(-1, 2, x.shape) * np.spacing(np.abs(x))

    other = replace(signals, q=moved(signals.q), q_ref=moved(signals.q_ref), effort=moved(signals.effort))
    for fit in (
        lambda s: identify_ls(s, Overrides()),
        lambda s: identify_iv(s, Overrides(), Iteration()),
    ):
        first, second = fit(signals), fit(other)
        moved = np.abs((first.beta - second.beta) / first.estimate.sigma).max()
        assert moved < 3e-8  # 1e-8 where links are computed at a stride: rounding of accelerations folds
