"""Long simulated recordings repeat their reference: they excite as well as ten seconds do."""

import numpy as np
from conftest import robot_named

from identification.model import InverseModel, base_parameters
from identification.regression import differentiate
from identification.study import random_reference


def condition(name: str, duration_s: float) -> float:
    """Of the regressor along the reference, 20 rows a second."""
    robot = robot_named(name)
    q = random_reference(robot, duration_s=duration_s, sample_rate_hz=100.0, seed=1)
    dq = differentiate(q, 100.0)
    motion = (x[::5] for x in (q, dq, differentiate(dq, 100.0)))
    model = InverseModel(robot)
    W = model.regressor(*motion)[:, :, base_parameters(model).columns].reshape(
        -1, base_parameters(model).b
    )
    return float(np.linalg.cond(W))


def test_hour_excites_like_ten_seconds():
    conditions = [condition("scara", duration_s) for duration_s in (10.0, 3600.0)]
    assert conditions[0] < 25
    np.testing.assert_allclose(conditions, conditions[0], rtol=0.02)


def test_whole_periods_near_requested_length():
    robot = robot_named("scara")
    for duration_s, period_s, expected in (
        (4.0, 10.0, 4.0),
        (12.0, 10.0, 12.0),
        (24.0, 10.0, 12.0),
        (24.0, 6.0, 6.0),
    ):
        q = random_reference(
            robot, duration_s=duration_s, sample_rate_hz=100.0, seed=1, period_s=period_s
        )
        period = round(100 * expected)
        np.testing.assert_allclose(q[period:], q[:-period], atol=1e-12)
        np.testing.assert_allclose(q[-1], q[0], atol=1e-12)
        assert np.abs(q[1] - q[0]).max() < 0.02 * np.abs(np.diff(q, axis=0)).max()  # from rest
        assert np.abs(q[period // 2 :] - q[: -(period // 2)]).max() > 0.1
