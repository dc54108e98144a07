"""`converged` is not said where a joint does not track or the instruments say
nothing of the regressor.
"""

import dataclasses
from types import SimpleNamespace

import msgspec
from conftest import REPLAY
from fits_of_records import short_recording, signals_of

from identification.methods import Iteration, Pass
from identification.methods.solution import status_of
from identification.regression import Overrides
from identification.report import DirectModelResidual
from identification.results import identify_iv


def verdict(tracking, errors, first_stage_F=500.0):
    settled = Pass(
        x=None, z=(), rows=None, estimate=None, intervals=None,
        lags=(), is_consistent=True,
        parameters_settled=True,
    )  # fmt: skip
    of = DirectModelResidual
    direct = [
        of(name=f"j{j}", position_error_percent=e, torque_error_percent=1.0)
        for j, e in enumerate(errors)
    ]
    robot = SimpleNamespace(kind="simulated", percent=tracking, by_joint=direct)
    settled = dataclasses.replace(settled, z=(robot,))
    # whether M is positive is asked of each recording
    none = SimpleNamespace(equations=(), x_of=lambda estimate, x: x)
    return status_of(none, settled, (settled, (robot,)), first_stage_F, None)


def test_every_joint_must_track():
    assert verdict(1.0, [1.0, 2.0]) == ("converged", None)
    status, reason = verdict(2.3, [0.5, 59.3])
    assert (status, reason) == (
        "not_confirmed",
        "simulated joint j1 differs by 59.3 % from the measured one",
    )
    assert (verdict(float("nan"), [1.0])[0], verdict(1.0, [float("nan")])[0]) == (
        "not_confirmed",
        "not_confirmed",
    )


def test_useless_instruments_not_converged(tmp_path):
    assert verdict(1.0, [1.0], 0.5)[0] == "diverged"
    signals = signals_of(short_recording(tmp_path / "5s.mcap", REPLAY / "scara" / "session.mcap"))
    slow = msgspec.structs.replace(signals.robot.controller, sample_rate_hz=50.0)
    robot = dataclasses.replace(signals.robot, controller=slow)
    fit = identify_iv(dataclasses.replace(signals, robot=robot), Overrides(), Iteration())
    assert fit.status == "diverged"
    assert "does not resemble the measured one" in fit.solution.reason
