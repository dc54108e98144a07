"""Terms of the equation of motion: together they leave nothing of a torque that the model predicts,
and their columns are the derivatives of their torques.
"""

from dataclasses import replace

import numpy as np
import pytest
from friction_models import exact_problem, whole_arm

from acquisition.robot import fourier_reference
from identification.regression import (
    equation_of,
    make_unknowns,
    motion_blocks,
    torque_of_recording,
)


@pytest.fixture(scope="module")
def exact():
    """The equation of an arm with coupled motors, every term of friction and a spring whose torque
    is known; x, and the motion.
    """
    arm = whole_arm()
    reference = fourier_reference(arm, period_s=3.0, seed=5)
    problem, beta = exact_problem(arm, reference.at(np.arange(0.0, 3.0, 1 / 250.0)))
    spring = 5.0 * problem.signals.q
    effort = problem.signals.effort - spring
    signals = replace(problem.signals, effort=effort, known_torque=spring)
    problem = replace(problem, signals=signals)
    unknowns = make_unknowns([problem], motors=(0, 5))
    x = unknowns.start([0.0])
    x[: len(beta)] = beta
    (motion,) = motion_blocks(problem)
    return equation_of(problem, unknowns, 0), x, motion


def test_terms_explain_exact_torque(exact):
    equation, x, motion = exact
    drives = equation.drives.with_gains_and_lag(x, motion)
    size = np.linalg.norm(equation.drives.torque(x, drives), axis=1)
    assert (np.linalg.norm(equation.residual(x, drives), axis=1) < 1e-9 * size).all()
    tau, (whole,), *_ = torque_of_recording(equation, x)  # from its first sample on
    np.testing.assert_allclose(whole, tau, atol=1e-9 * np.abs(tau).max())
    predicted = motion.with_torque_of(equation.arm.beta(x))
    for of in (drives, predicted):
        np.testing.assert_allclose(
            of.tau + of.known_torque, motion.tau, atol=1e-9 * np.abs(motion.tau).max()
        )


@pytest.mark.parametrize("late_s", [0.0, 0.0013])
def test_columns_are_torque_derivatives(exact, late_s):
    """At gains off by a tenth. The sign of the links' torque has no filter in the columns of load
    friction, and the rate of a torque, which friction lets jump, is that of its samples.
    """
    equation, x, motion = exact
    x = x + np.where(np.isin(np.arange(len(x)), equation.drives.gains), 0.1, 0.0)
    x[equation.unknowns.lags] = late_s
    for term, rel in zip(equation.terms, (1e-6, 0.05, 0.05), strict=True):
        J = term.columns(x, equation.drives.with_gains_and_lag(x, motion))
        for i in [
            *np.random.default_rng(0).permutation(len(x))[:20].tolist(),
            *equation.drives.gains[[0, 5]],
            -1,
        ]:
            h = np.zeros(len(x))
            h[i] = 1e-4 if i == -1 else 1e-3 * max(abs(x[i]), 1e-3)
            above, below = (
                term.torque(at, equation.drives.with_gains_and_lag(at, motion))
                for at in (x + h, x - h)
            )
            slope = (above - below) / (2 * h[i])
            assert np.linalg.norm(J[:, i] - slope) <= rel * np.linalg.norm(slope)
