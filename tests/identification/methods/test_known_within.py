"""What is stated of a payload is known within limits: gains of an arm by MuJoCo hold, or the
verdict names the cause.
"""

from dataclasses import replace

import mujoco_arm
import numpy as np
import pytest
from fits_of_records import cut
from gain_cases import GainCase, fit_with_gains, gains_of, off_in_half_widths
from planned_pairs import planned_pair

import identification
from identification.data import Recordings
from identification.estimation import (
    System,
    combined,
    intervals_of,
    one_thread,
    weighted_least_squares,
)
from identification.regression import Overrides

SCATTERED = np.exp([0.16, -0.14, 0.2, -0.05, 0.12, -0.18])  # of a catalogue: 15 %
SCARA = GainCase(robot="scara", white=5.0)


@pytest.mark.parametrize(
    ("off_m", "mass_kg", "told"),
    [
        ((0.003, 0, 0), 2.0, None),
        ((0, 0, 0.015), 2.0, "centre of mass"),
        ((0, 0, 0), 1.0, "drive gains"),
    ],
)
def test_wrong_payload_value_reported(off_m, mass_kg, told):
    """Taken as exact, 3 mm would move the last gain by 2.8 half-widths.

    The gains of the catalogue scatter by 15 %.
    """
    # half of it names what is wrong
    pair = [
        cut(one, len(one.q) // 2 if told else None)
        for one in mujoco_arm.pair(mujoco_arm.GAINS * SCATTERED, off_m=off_m, mass_kg=mass_kg)
    ]
    fit = one_thread(fit_with_gains)(*pair)
    assert [line.test for line in fit.trust.lines if line.level == "caution"] == (
        [told] if told else []
    )
    assert fit.trust.verdict == ("caution" if told else "trust")
    if told == "drive gains":
        assert "Check the payload's mass" in fit.trust.line("drive gains").advice
        return
    assert (off_in_half_widths(fit, mujoco_arm.GAINS) <= 2).all()
    assert (gains_of(fit)[1] < 0.01 * mujoco_arm.GAINS).all()
    ((_, value, half, _),) = fit.trust.line("centre of mass").figures
    # mm; by the noise no less than 0.03
    assert max(abs(value - 1e3 * np.linalg.norm(off_m)), 0.03) <= 2 * half < 1.0


def test_given_value_combined_by_variances():
    """The minimum of both sums of squares, and the intervals of both."""
    rng = np.random.default_rng(0)
    W, names = rng.standard_normal((2, 300, 3)) @ np.triu(np.ones((3, 3))), ("a", "b", "c")
    Y = W @ [1.0, 2.0, 3.0] + 0.3 * rng.standard_normal((2, 300))
    system = System.whole(W.reshape(-1, 3), Y.reshape(-1), np.repeat([0, 1], 300), names)
    free = weighted_least_squares(system)
    found = intervals_of(system, free)
    both = combined(system, free, {"b": (2.01, 0.02)})
    information, sd = np.linalg.inv(found.covariance), 0.02 / found.reach
    stated = np.diag([0.0, sd**-2, 0.0])
    expected = np.linalg.solve(
        information + stated, information @ free.beta + stated @ [0.0, 2.01, 0.0]
    )
    np.testing.assert_allclose(both.beta, expected, rtol=1e-9)
    np.testing.assert_allclose(
        both.stated[1], sd * np.linalg.inv(information + stated)[1, 1] / sd**2, rtol=1e-9
    )
    assert (intervals_of(system, both).sigma <= found.sigma).all()
    assert combined(system, free, {"b": (2.5, 0.02)}) is free  # the rows contradict it


def test_narrow_given_value_is_exact():
    free, loaded = planned_pair(SCARA)
    exact, narrow, wide = (
        gains_of(
            fit_with_gains(
                free, replace(loaded, payload=replace(loaded.payload, center_half_width_m=x))
            )
        )
        for x in (0.0, 1e-6, 0.005)
    )
    np.testing.assert_allclose(narrow[0], exact[0], rtol=1e-4)
    # the cosines see other columns removed
    np.testing.assert_allclose(narrow[1], exact[1], rtol=0.1)
    assert (wide[1] > exact[1]).all()


def test_one_motor_of_wrong_sign_named():
    turned = []
    for one in planned_pair(SCARA):
        current = one.robot.motor_effort(one.effort) * [1.0, -1.0]
        turned.append(replace(one, effort=one.robot.joint_effort(current)))
    line = fit_with_gains(*turned).trust.line("drive gains")
    assert line.level == "do not use"
    assert line.text.startswith("wrong sign of motor_2: its drive gain is negative")


def test_pair_friction_terms_by_cross_validation():
    found = identification.select_friction(
        Recordings(sources=planned_pair(SCARA)), Overrides(gains=("all",))
    )
    assert found.held_out == tuple(f"fifth {k}" for k in range(1, 6))
    assert found.recommended is found.usual
    assert (np.abs(found.robot.gain / SCARA.gains - 1) < 0.05).all()


def test_arrays_of_pair_give_gains():
    free, loaded = planned_pair(SCARA)
    both, rate_hz, payload = (free, loaded), free.sample_rate_hz, (None, "2@0.05,0.02,0")
    arrays = [one.q for one in both], [one.effort for one in both], rate_hz, free.robot
    fit = identification.fit(*arrays, payload=payload, gains=("all",), torque_lag_s=0.0)
    assert (off_in_half_widths(fit.evidence, SCARA.gains) <= 1.5).all()
