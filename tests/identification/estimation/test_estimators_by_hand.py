"""Weights, estimates, covariances and tests of small systems, from the formulas as
they stand in the papers.
"""

import numpy as np
import pytest
from rows_by_hand import of_instants
from scipy import stats

from identification.errors import NoFitError
from identification.estimation import (
    System,
    chi_squared_quantile,
    essential_parameters,
    f_tail,
    first_stage,
    instrumental_variables,
    ordinary_least_squares,
    orthonormal,
    r_factor,
    t_quantile,
    weighted_least_squares,
)


def system(seed: int, r: int, b: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Z, W (r, b) and Y (r,) that have something, but not all, in common."""
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(r, b))
    Z = W + 0.5 * rng.normal(size=(r, b))
    return Z, W, W @ np.arange(1.0, b + 1) + rng.normal(size=r)


def test_weighted_iv_matches_formula():
    Z, W, Y = system(1, 40, 3)
    joints, weights = np.repeat([0, 1], 20), np.array([3.0, 0.2])
    used = np.arange(40) % 5 > 0
    fit = instrumental_variables(of_instants(W, Y, joints, (20,), used), Z[used], weights)
    D2 = np.diag(weights[joints] ** 2 * used)
    inverse = np.linalg.inv(Z.T @ D2 @ W)
    np.testing.assert_allclose(fit.beta, inverse @ Z.T @ D2 @ Y, rtol=1e-10)
    rho = Y - W @ fit.beta
    s2 = rho @ D2 @ rho / (32 - 1)
    np.testing.assert_allclose(fit.covariance, s2 * inverse @ Z.T @ D2 @ Z @ inverse.T, rtol=1e-9)
    # beta - beta_true = bread Qᵀ rho is what every robust deviation is made from.
    true = np.arange(1.0, 4.0)
    np.testing.assert_allclose(
        fit.bread @ fit.Q.T @ (np.sqrt(np.diag(D2)) * (Y - W @ true))[used],
        fit.beta - true,
        atol=1e-10,
    )
    unweighted = np.linalg.solve(Z.T @ np.sqrt(D2) @ W, Z.T @ np.sqrt(D2) @ Y)
    # weights on Z too: it makes a difference here
    assert np.abs(unweighted - fit.beta).max() > 1e-3


def test_weights_use_rank_of_joint_columns():
    """Joint 1: six rows, three columns.

    Joint 2: five rows, three columns of which one is twice another: rank 2.
    """
    rng = np.random.default_rng(4)
    W = np.zeros((11, 4))
    W[:6, [0, 1, 3]] = rng.normal(size=(6, 3))
    W[6:, 1:3] = rng.normal(size=(5, 2))
    W[6:, 3] = 2 * W[6:, 2]
    Y = rng.normal(size=11)
    joints = np.repeat([0, 1], [6, 5])
    found = weighted_least_squares(System.whole(W, Y, joints, tuple("abcd"))).weights
    for j, (columns, freedom) in enumerate((([0, 1, 3], 3), ([1, 2], 3))):
        A, y = W[joints == j][:, columns], Y[joints == j]
        rho = y - A @ np.linalg.solve(A.T @ A, A.T @ y)
        assert found[j] == pytest.approx(np.sqrt(freedom / (rho @ rho)), rel=1e-10)
    # The weighted estimate is that of the rows divided by s_j.
    full = W[:, :3]
    problem = System.whole(full, Y, joints, tuple("abc"))
    fit = weighted_least_squares(problem)
    D = np.diag(fit.weights[joints])
    np.testing.assert_allclose(fit.beta, np.linalg.lstsq(D @ full, D @ Y, rcond=None)[0], rtol=1e-9)
    rho = D @ (Y - full @ fit.beta)
    np.testing.assert_allclose(
        fit.covariance, rho @ rho / 10 * np.linalg.inv(full.T @ D @ D @ full), rtol=1e-9
    )


def test_reduction_f_test_matches_formula():
    """F = ((RSS_reduced - RSS_full)/dropped) / (RSS_full/(r - b)); twelve rows and five columns, so
    that each number shows.
    """
    rng = np.random.default_rng(12)
    W = rng.normal(size=(12, 5))
    Y = W @ np.array([50.0, 0.01, -40.0, 0.0, 60.0]) + rng.normal(size=12)
    problem = System.whole(W, Y, np.zeros(12, dtype=int), tuple("abcde"))
    full = ordinary_least_squares(problem)
    reduced = essential_parameters(problem, full, correlation=0.2)
    assert reduced.names == ("a", "c", "e")
    rss = {}
    for kept in ((0, 1, 2, 3, 4), (0, 2, 4)):
        A = W[:, kept]
        rho = Y - A @ np.linalg.lstsq(A, Y, rcond=None)[0]
        rss[len(kept)] = rho @ rho
    F = (rss[3] - rss[5]) / 2 / (rss[5] / 7)
    assert pytest.approx(F) == reduced.F
    assert reduced.p_value == pytest.approx(stats.f.sf(F, 2, 7))
    share = 0.8 / 1.2  # of twelve rows eight are independent
    assert reduced.F_effective == pytest.approx(share * F)
    assert reduced.p_effective == pytest.approx(stats.f.sf(share * F, 2, 8 - 5))
    assert essential_parameters(problem, full, correlation=-0.5).F_effective == reduced.F


def test_first_stage_is_column_on_instrument():
    Z, W, _ = system(6, 30, 1)
    w, z = W[:, :1], Z[:, :1]
    fitted = z @ (z.T @ w) / (z.T @ z)
    first = (fitted.T @ fitted).item() / (((w - fitted).T @ (w - fitted)).item() / 29)
    assert first_stage(z / np.linalg.norm(z), w, 30)[1] == pytest.approx(first)


def test_zero_torque_joint_has_bounded_weight():
    W = np.random.default_rng(3).normal(size=(12, 2))
    Y = np.r_[np.zeros(6), np.arange(6.0) ** 2]
    weights = weighted_least_squares(System.whole(W, Y, np.repeat([0, 1], 6), ("a", "b"))).weights
    assert weights[0] / weights[1] == pytest.approx(1e6)


@pytest.mark.parametrize(("ratio", "kept"), [(30.0, ("a", "b")), (10.0, ("a",))])
def test_reduction_ends_at_given_error_ratio(ratio, kept):
    """Orthonormal columns, s = 1: %sigma 5 and 66.7, a ratio of 13.3; F = 1.5² (r - 2)/(r - 1)
    does not keep the second.
    """
    Q = np.linalg.qr(np.random.default_rng(8).normal(size=(40, 3)))[0]
    W, Y = Q[:, :2], Q @ np.array([20.0, 1.5, np.sqrt(39.0)])
    problem = System.whole(W, Y, np.zeros(40, dtype=int), ("a", "b"))
    full = ordinary_least_squares(problem)
    np.testing.assert_allclose(full.sigma_percent, [5.0, 100 / 1.5])
    reduced = essential_parameters(problem, full, correlation=0.0, ratio=ratio)
    assert reduced.names == kept
    if len(kept) == 1:
        assert pytest.approx(1.5**2 * 38 / 39) == reduced.F


def test_rounding_only_column_not_excited():
    rng = np.random.default_rng(5)
    W = rng.normal(size=(30, 3)) * np.array([1.0, 1e-14, 1.0])
    with pytest.raises(NoFitError, match="parameters = b: they have no effect on the torque"):
        ordinary_least_squares(
            System.whole(W, rng.normal(size=30), np.zeros(30, dtype=int), tuple("abc"))
        )


def test_f_tail_matches_scipy():
    rng = np.random.default_rng(7)
    for F, dropped, freedom in zip(
        rng.exponential(4.0, 300), rng.integers(1, 100, 300), rng.uniform(1, 1e6, 300), strict=True
    ):
        assert f_tail(F, dropped, freedom) == pytest.approx(
            stats.f.sf(F, dropped, freedom), rel=1e-8, abs=1e-280
        )
    assert f_tail(-1e-17, 3, 20) == 1.0  # rounding of a residual that does not grow
    assert f_tail(np.inf, 3, 20) == 0.0


@pytest.mark.parametrize("freedom", [1, 2, 16, 1000])
def test_quantiles_match_distributions(freedom):
    for tail in (0.2, 0.025, 1e-3):
        assert t_quantile(1 - tail, freedom) == pytest.approx(stats.t.isf(tail, freedom), rel=1e-12)
        assert chi_squared_quantile(tail, freedom) == pytest.approx(
            stats.chi2.isf(tail, freedom), rel=1e-12
        )


@pytest.mark.parametrize("condition", [1.0, 1e6])
@pytest.mark.parametrize("rows", [5, 2048, 5000])
def test_factors_of_tall_matrices(rows, condition):
    """Blocks of rows factored on their own: RᵀR = AᵀA, and orthonormal columns that span A's,
    well conditioned or not.
    """
    rng = np.random.default_rng(3)
    A = (
        rng.normal(size=(rows, 4))
        @ np.linalg.qr(rng.normal(size=(4, 4)))[0]
        * np.geomspace(1, 1 / condition, 4)
    )
    A = A @ np.linalg.qr(rng.normal(size=(4, 4)))[0]
    R, Q = r_factor(A), orthonormal(A)
    assert R.shape == (4, 4)
    np.testing.assert_array_equal(np.tril(R, -1), 0.0)
    # A is scaled so that a lost digit of its small directions shows.
    small = np.linalg.svd(A)[2][-1]
    assert np.linalg.norm(R @ small) == pytest.approx(np.linalg.norm(A @ small), rel=1e-6)
    np.testing.assert_allclose(Q.T @ Q, np.eye(4), atol=1e-11)
    np.testing.assert_allclose(Q @ (Q.T @ A), A, atol=1e-11 * np.abs(A).max())
