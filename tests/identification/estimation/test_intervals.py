"""Intervals by equal-weighted cosines: closed forms, rows of spans of time."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from rows_by_hand import of_instants
from scipy import stats

from identification.estimation import (
    FINE_SPANS,
    SPANS,
    SpanRows,
    System,
    cosines,
    deviations,
    deviations_of_sums,
    instrumental_variables,
    intervals_of,
    ordinary_least_squares,
    spans_at,
    stacked,
)

# Closed forms


@pytest.fixture(autouse=True)
def _as_a_long_recording(monkeypatch):
    monkeypatch.setattr("identification.estimation.system.SHORT", 0)


@pytest.mark.parametrize(
    ("T", "most", "B"),
    [(10, 16, 4), (63, 16, 6), (252, 16, 15), (253, 16, 16), (10**6, 16, 16), (10**6, 48, 48)],
)
def test_number_of_cosines(T, most, B):
    assert cosines(T, most) == B


@pytest.mark.parametrize(("T", "B"), [(120, 9), (300, 16)])
def test_interval_steps_by_hand(T, B):
    """Scores of two joints, bread, weights, rows that do not count, and what white noise leaves,
    worked out row by row; of 300 instants two or three have a span, which counts as one.
    """
    rng = np.random.default_rng(2)
    W, Z = rng.normal(size=(2, 2 * T, 3))
    Z = W + 0.3 * Z
    Y, weights = W @ [1.0, -2.0, 0.5] + rng.normal(size=2 * T), np.array([2.0, 0.3])
    used, joint = rng.uniform(size=2 * T) > 0.4, np.repeat([0, 1], T)
    system = System.whole(W, Y, joint, tuple("abc")).part(used)
    found = instrumental_variables(system, Z[used], weights)
    by_rows = intervals_of(system, found)
    D = weights[joint] * used
    rho = (Y - W @ found.beta) * D
    # beta - beta_true = to_beta rho
    to_beta = np.linalg.inv(Z.T @ (D[:, None] ** 2 * W)) @ (D[:, None] * Z).T
    span = np.arange(T) * 120 // T
    S = np.zeros((120, 3))
    for t in range(T):
        S[span[t]] += to_beta[:, t] * rho[t] + to_beta[:, T + t] * rho[T + t]
    L = [
        np.sqrt(2) * sum(np.cos(np.pi * k * (p + 0.5) / 120) * S[p] for p in range(120))
        for k in range(1, B + 1)  # 0.4 T^(2/3) = 9.7, or 17.9 of which are 16
    ]
    Q = np.zeros((2 * T, 3))
    Q[used] = found.Q
    of_white = np.zeros(3)
    for k in range(1, B + 1):  # L_k = a'(I - QQ')e
        a = np.sqrt(2) * np.cos(np.pi * k * (np.tile(span, 2) + 0.5) / 120) * to_beta
        of_white += np.sum((a - a @ Q @ Q.T) ** 2, axis=1) / B
    variance = np.mean(np.square(L), axis=0) / of_white * np.sum(to_beta**2, axis=1)
    np.testing.assert_allclose(by_rows.sigma, np.sqrt(variance), rtol=1e-9)
    assert by_rows.freedom == B
    reach = stats.t.ppf(0.975, B) * by_rows.sigma
    np.testing.assert_allclose(by_rows.low, found.beta - reach, rtol=1e-9)
    np.testing.assert_allclose(by_rows.high, found.beta + reach, rtol=1e-9)


@pytest.mark.parametrize("parts", [(120,), (50, 70)])
def test_slow_column_has_true_standard_error(parts):
    """Of white noise and a drift beside five slow columns: z'e, z what the drift adds to them,
    has the variance |z|².

    Its estimate is a square of e, so that its mean over white noise is its sum over the
    unit vectors. What the estimate takes out of the residuals makes it over a fifth less
    where it is not counted.
    """
    n, T = 2, 120
    time = np.tile(np.arange(T) / T, n)
    joint = np.repeat(np.eye(n), T, axis=0)
    W = np.concatenate(
        [joint, joint * np.cos(4 * time)[:, None], np.sin(7 * time)[:, None]], axis=1
    )
    Q = np.linalg.qr(W)[0]
    drift = joint[:, 0] * time
    z = drift - Q @ (Q.T @ drift)
    rho = np.eye(n * T) - Q @ Q.T - np.outer(z, z) / (z @ z)
    columns = np.repeat(z[:, None], n * T, axis=1)
    whole = of_instants(W, drift, np.repeat(np.arange(n), T), parts, np.full(n * T, True))
    found = deviations_of_sums(whole, columns, rho, Q)
    assert found @ found == pytest.approx(z @ z, rel=1e-9)
    scores, edges = (columns * rho).reshape(n, T, -1).sum(axis=0), np.cumsum([0, *parts])
    apart = [deviations(scores[a:b], cosines(b - a)) ** 2 for a, b in pairwise(edges)]
    assert np.sum(apart) < 0.8 * (z @ z)


def test_covariance_matches_intervals_and_formula():
    rng = np.random.default_rng(3)
    W = rng.normal(size=(200, 6)) @ rng.normal(size=(6, 6))
    Y = W @ np.ones(6) + rng.normal(size=200)
    system = System.whole(W, Y, np.zeros(200, dtype=int), tuple("abcdef"))
    fit = ordinary_least_squares(system)
    found = intervals_of(system, fit)
    C = np.linalg.inv(W.T @ W)
    expected = C * np.outer(found.sigma, found.sigma) / np.sqrt(np.outer(np.diag(C), np.diag(C)))
    np.testing.assert_allclose(found.covariance, expected, atol=1e-12 * expected.max())
    exact = intervals_of(
        dataclasses.replace(system, Y=W @ fit.beta),
        dataclasses.replace(fit, covariance=np.zeros((6, 6))),
    )
    np.testing.assert_array_equal(exact.covariance, 0)


# Spans of time


def test_intervals_of_several_recordings_by_hand():
    """Variances of the recordings' own cosines add up, each over the share of white noise
    that its cosines find.
    """
    parts, n, b, rng = (40, 90), 2, 3, np.random.default_rng(8)
    T = sum(parts)
    W, Y, joint = rng.normal(size=(n * T, b)), rng.normal(size=n * T), np.repeat([0, 1], T)
    time, variance, freedom = np.tile(np.arange(T), n), np.zeros(b), 0
    system = stacked(
        [
            of_instants(W[at], Y[at], joint[at], (part,), np.full(n * part, True))
            for part, at in zip(parts, (time < 40, time >= 40), strict=True)
        ]
    )
    fit = ordinary_least_squares(system)
    rho, found = Y - W @ fit.beta, intervals_of(system, fit)
    rows = fit.Q @ fit.bread.T  # beta - beta_true = rows' rho
    for first, length in ((0, 40), (40, 90)):
        inside = (time >= first) & (time < first + length)
        B = int(0.4 * length ** (2 / 3))
        L, white, whole = np.zeros(b), np.zeros(b), (rows[inside] ** 2).sum(axis=0)
        for k in range(1, B + 1):
            a = (
                rows
                * (inside * np.sqrt(2) * np.cos(np.pi * k * (time - first + 0.5) / length))[:, None]
            )
            L += (a.T @ rho) ** 2 / B
            white += ((a**2).sum(axis=0) - ((fit.Q.T @ a) ** 2).sum(axis=0)) / B
        variance, freedom = variance + L / (white / whole), freedom + B
    assert found.freedom == freedom
    np.testing.assert_allclose(found.sigma, np.sqrt(variance), rtol=1e-9)
    np.testing.assert_allclose(
        found.half, stats.t.ppf(0.975, freedom) * np.sqrt(variance), rtol=1e-6
    )


@pytest.mark.parametrize(("short", "count"), [(0, SPANS), (2000, FINE_SPANS)])
def test_blocks_are_equal_with_row_products(short, count, monkeypatch):
    """1010 instants in 120 spans of 8 or 9, or 240 of 4 or 5, brought in pieces that end within a
    span; the second joint feels three of seven columns, and slow rows and fast ones stay apart.
    """
    monkeypatch.setattr("identification.estimation.system.SHORT", short)
    T, n, rng = 1010, 2, np.random.default_rng(9)
    columns, share = rng.normal(size=(n, 7, T)), rng.uniform(size=(T, n)).round(1)
    columns[1, [0, 1, 3, 4]] = 0.0
    share[30:50, 0] = 0.0  # a span may have fewer rows than columns
    columns *= share.T[:, None]
    quick = rng.uniform(size=(n, T)) > 0.3
    rows = SpanRows()
    for a, z in ((0, 13), (13, 500), (500, 501), (501, T)):
        rows.add(SpanRows.of_block(T, a, columns[..., a:z], share[a:z].T, quick[:, a:z]))
    found, fast, followed = rows.rows(share)
    (spans,), (joint, span) = followed["spans"], (followed[x] for x in ("joint_of_row", "span"))
    assert (spans[-1], len(spans)) == (T, count + 1)
    assert set(np.diff(spans)) == {T // count, T // count + 1}
    np.testing.assert_array_equal(
        np.arange(T) * count // T, np.repeat(range(count), np.diff(spans))
    )
    np.testing.assert_allclose(followed["rows"], (share**2).sum(axis=0), rtol=1e-12)
    assert (np.diff(joint) >= 0).all()
    for j, k, kind in np.ndindex(n, count, 2):
        a, z = spans[k : k + 2]
        one = columns[j, :, a:z][:, (share[a:z, j] > 0) & (quick[j, a:z] == kind)]
        own = found[(joint == j) & (span == k) & (fast == kind)]
        np.testing.assert_allclose(own.T @ own, one @ one.T, rtol=1e-9, atol=1e-12)
        assert len(own) == min(one.shape[1], T if short else (7, 3)[j])
    rows.add(SpanRows.of_block(T, 0, columns, 0.0 * share.T))
    assert rows.rows(0.0 * share)[0].shape == (0, 7)  # no row counts


def test_other_rows_belong_to_containing_block():
    """Of two recordings; behind the end the last span."""
    spans = np.array([0, 10, 20, 30]), np.array([0, 5, 10])
    instants = np.array([0, 9, 10, 29, 30]), np.array([4, 5, 12])
    assert spans_at(spans, instants).tolist() == [0, 0, 1, 2, 2, 3, 4, 4]
