"""Where most of a motion is, whatever joints that stand show."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY

from identification.data import load_signals
from identification.regression import Overrides, make_problem
from identification.regression.motion import motion_band_hz


@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_resting_joints_do_not_set_band(noise):
    signals = load_signals(REPLAY / "scara" / "session.mcap")
    q = signals.q.copy()
    q[:, 1] = q[0, 1] + noise * np.random.default_rng(0).standard_normal(len(q))
    assert 0.1 < motion_band_hz(replace(signals, q=q)) <= motion_band_hz(signals)


def test_resting_joint_keeps_filters():
    signals = load_signals(REPLAY / "scara" / "session.mcap")
    q = signals.q.copy()
    q[:, 1] = q[0, 1]
    both = (
        make_problem(x, Overrides()).for_errors.settings for x in (signals, replace(signals, q=q))
    )
    (cutoff_hz, n_d), other = ((x.cutoff_hz, x.decimation) for x in both)
    assert other == (pytest.approx(cutoff_hz, rel=0.3), pytest.approx(n_d, rel=0.3))
