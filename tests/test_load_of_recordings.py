"""Load friction of several recordings: by hand, and the truth inside."""

import dataclasses
from functools import cache

import msgspec
import numpy as np
import pytest
from test_friction_terms import described, model_of, simulated

from identification.methods import Iteration, identify_iv, identify_ls
from identification.regression import Overrides, make_problem, regression_of_recording

TERMS = [["viscous", "coulomb", "root", "load"], ["viscous", "coulomb", "load"]]
VALUES = "Fr1 = 0.6\nmu1 = 0.3\nmu2 = 0.3\n"


@cache
def scara(own: str = ""):
    """The SCARA with load friction of both joints, and 3 recordings of it; offsets are shared or of each."""
    offsets = "Off1 = 0.3\n" if own else ""
    terms = [[*more[:2], "offset", *more[2:]] if own else more for more in TERMS]
    robot = described("scara", terms, VALUES + offsets)
    if own:
        robot = dataclasses.replace(robot, identification=msgspec.structs.replace(robot.identification, own=(own,)))
    return robot, simulated(robot, 3, 4, 5)


def fitted(given, method: str):
    if method == "iv":
        return identify_iv(given, Overrides(), Iteration())
    return identify_ls(given, Overrides(), trust=True)


@cache
def fit_of(method: str, own: str = ""):
    return fitted(scara(own)[1], method)


def off(fit, values) -> np.ndarray:
    """Distances of estimates from values of base parameters, in half-widths of the interval."""
    names = [name.partition("@")[0] for name in fit.estimate.names]
    expected = np.array([values[fit.base.names.index(name)] for name in names])
    return np.abs(fit.estimate.beta - expected) / fit.intervals.half


def about(problem, beta):
    """W (n, rows, b) and Y (n, rows) of a recording about beta, by the formulas, from the whole regressor."""
    s, model, base = problem.settings, problem.model, problem.base
    m = problem.motion.between(s.start, s.stop, s.cutoff_hz)
    series = model.regressor(m.q, m.dq, m.ddq)[:, :, base.columns]  # (N, n, b)
    W = np.stack([s.decimator.filtered(series[:, j].T).T for j in range(series.shape[1])])
    Y = s.decimator.filtered(m.tau.T)
    for j in range(len(W)):
        mu = base.names.index(f"mu{j + 1}")
        rigid, sign = series[:, j, base.links] @ beta[base.links], np.sign(m.dq[:, j])
        moved = beta[mu] * s.decimator.kept(np.sign(rigid) * sign)[:, None] * W[j][:, base.links]
        Y[j] = Y[j] + moved @ beta[base.links]
        W[j][:, base.links] += moved
        W[j][:, mu] = s.decimator.filtered((np.abs(rigid) * sign)[None])[0]
    return W, Y


def weighted_least_squares(W, Y, joint):
    """Estimate and deviations: rows over the residual of each joint's own least squares."""
    s = np.ones(2)
    for j in range(2):
        own, rows = W[joint == j], Y[joint == j]
        own = own[:, own.any(axis=0)]
        own = own / np.linalg.norm(own, axis=0)
        b, _, rank, _ = np.linalg.lstsq(own, rows, rcond=1e-9)
        s[j] = np.sqrt(np.sum((rows - own @ b) ** 2) / (len(rows) - rank))
    A, b = W / s[joint][:, None], Y / s[joint]
    beta = np.linalg.lstsq(A, b)[0]
    variance = np.sum((b - A @ beta) ** 2) / (len(b) - A.shape[1])
    return beta, np.sqrt(variance * np.diag(np.linalg.inv(A.T @ A)))


def test_least_squares_of_recordings_is_that_of_their_rows_stacked():
    """Pass by pass by hand, from the fit without load friction on, until no parameter moves by half its deviation."""
    _, given = scara()
    problems = [make_problem(signals, Overrides()) for signals in given.sources]
    fast = [regression_of_recording(problem).fast.T for problem in problems]  # (n, rows)
    joint = np.concatenate([np.nonzero(rows)[0] for rows in fast])

    def rows(beta):
        each = [about(problem, beta) for problem in problems]
        return (np.concatenate([x[i][used] for x, used in zip(each, fast, strict=True)]) for i in range(2))

    names = problems[0].base.names
    linear = np.array([not name.startswith("mu") for name in names])
    W, Y = rows(np.zeros(len(names)))
    beta, passes, moved = np.zeros(len(names)), 0, np.inf
    beta[linear], _ = weighted_least_squares(W[:, linear], Y, joint)
    while moved > 0.5:
        W, Y = rows(beta)
        after, sigma = weighted_least_squares(W, Y, joint)
        beta, moved, passes = after, np.abs((after - beta) / sigma).max(), passes + 1
    assert passes > 1
    assert off(fit_of("wls"), beta).max() < 1e-9


@pytest.mark.parametrize("own", ["", "Off"])
@pytest.mark.parametrize("method", ["wls", "iv"])
def test_the_truth_is_inside_and_no_test_warns(method, own):
    fit = fit_of(method, own)
    robot, _ = scara(own)
    assert fit.status == ("converged" if method == "iv" else "solved")
    assert {"mu1", "mu2"} < set(fit.estimate.names)
    assert ("Off1@r3" in fit.estimate.names) == bool(own)
    found = off(fit, model_of(robot)[2])
    assert (found < 1).sum() >= len(found) - 2
    assert found.max() < 2.5
    assert fit.intervals.half[fit.estimate.names.index("mu1")] < 0.05
    levels = {line.test: line.level for line in fit.trust.lines}
    assert set(levels.values()) <= {"ok", "cannot tell", "not made"}, levels
    assert levels["physical"] == levels["held-out blocks"] == "ok"
