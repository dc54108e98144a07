"""The pairs of recordings with drive gains: by the true gains, least squares finds the robot and what the payload adds."""

import gain_cases
import numpy as np
import pytest
from gain_cases import GainCase, pairs_of, with_gains

from identification.methods import identify_ls
from identification.model import InverseModel, described_parameters
from identification.model.physical import link_columns
from identification.regression import Overrides


@pytest.mark.parametrize(("robot", "catalogue"), [("emps", True), ("scara", False), ("tx40", True), ("axis", False)])
def test_the_true_gains_give_the_robot_and_its_payload(robot, catalogue, monkeypatch):
    monkeypatch.setattr(gain_cases, "with_stated", lambda signals, *_: signals)
    case = GainCase(robot=robot, what="", catalogue=catalogue, duration_s=5.0, mass_kg=20.0 if robot == "emps" else 2.0)
    pair = pairs_of(case, range(1))[0]
    fits = [identify_ls(with_gains(x, pair.gains, None), Overrides()) for x in (pair.free, pair.loaded)]
    base, model = fits[0].base, InverseModel(fits[0].problem.signals.robot)
    true = described_parameters(model, base)
    carried = true + base.K[:, link_columns(model)[-1]] @ pair.payload
    for fit, expected in zip(fits, (true, carried), strict=True):
        assert (np.abs(fit.beta - expected) <= 3 * fit.intervals.half + 0.003 * np.abs(expected)).all()
        assert fit.errors[-1].moving_relative_error_percent < 3
