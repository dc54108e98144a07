"""Intervals by equal-weighted cosines: closed forms, long recordings held reduced."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from conftest import REPLAY
from scipy import stats

import identification.regression.equations as regression_module
from identification.data import load_signals
from identification.estimation import (
    SPANS,
    SpanFactors,
    Spans,
    System,
    deviations_of_sums,
    instrumental_variables,
    intervals,
    intervals_of,
    ordinary_least_squares,
    stacked,
    weighted_least_squares,
)
from identification.estimation.confidence import MAX_COSINES, cosines, deviations
from identification.methods import identify_ls
from identification.regression import Overrides

# Closed forms


@pytest.mark.parametrize(
    ("T", "B"), [(10, 4), (63, 6), (100, 8), (252, 15), (253, 16), (10**6, 16)]
)
def test_how_many_cosines(T, B):
    assert cosines(T) == B


def test_every_step_from_rows_to_an_interval():
    """Scores of two joints, bread, weights, rows that do not count, and what white noise leaves,
    worked out row by row.
    """
    T, rng = 120, np.random.default_rng(2)
    W, Z = rng.normal(size=(2, 2 * T, 3))
    Z = W + 0.3 * Z
    Y, weights = W @ [1.0, -2.0, 0.5] + rng.normal(size=2 * T), np.array([2.0, 0.3])
    used = (rng.uniform(size=2 * T) > 0.4).astype(float)
    joint = np.repeat([0, 1], T)
    system = System.whole(W, Y, joint, tuple("abc")).with_rows(used)
    found = instrumental_variables(system, Z, weights)
    rho = (Y - W @ found.beta) * weights[joint] * used
    by_rows = intervals(found, rho, 2)
    D = weights[joint] * used
    # beta - beta_true = to_beta rho
    to_beta = np.linalg.inv(Z.T @ (D[:, None] ** 2 * W)) @ (D[:, None] * Z).T
    S = np.array([to_beta[:, t] * rho[t] + to_beta[:, T + t] * rho[T + t] for t in range(T)])
    B = 9  # 0.4 T^(2/3) = 9.7
    L = [
        np.sqrt(2 / T) * sum(np.cos(np.pi * k * (t + 0.5) / T) * S[t] for t in range(T))
        for k in range(1, B + 1)
    ]
    H = found.Q @ found.Q.T
    at = np.tile(np.arange(T), 2)
    of_white = np.zeros(3)
    for k in range(1, B + 1):  # L_k = a'(I - H)e
        a = np.sqrt(2 / T) * np.cos(np.pi * k * (at + 0.5) / T) * to_beta
        of_white += np.sum((a - a @ H) ** 2, axis=1) / B
    variance = np.mean(np.square(L), axis=0) / of_white * np.sum(to_beta**2, axis=1)
    np.testing.assert_allclose(by_rows.sigma, np.sqrt(variance), rtol=1e-9)
    np.testing.assert_allclose(
        by_rows.low, found.beta - stats.t.ppf(0.975, 9) * by_rows.sigma, rtol=1e-9
    )
    np.testing.assert_allclose(
        by_rows.high, found.beta + stats.t.ppf(0.975, 9) * by_rows.sigma, rtol=1e-9
    )


@pytest.mark.parametrize("parts", [(120,), (50, 70)])
def test_a_slow_column_has_the_deviation_of_its_coefficient(parts):
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
    found = deviations_of_sums(
        columns, rho, Q, n, [Spans(instants=part, count=part) for part in parts]
    )
    assert found @ found == pytest.approx(z @ z, rel=1e-9)
    scores, edges = (columns * rho).reshape(n, T, -1).sum(axis=0), np.cumsum([0, *parts])
    apart = [deviations(scores[a:b], cosines(b - a)) ** 2 for a, b in pairwise(edges)]
    assert np.sum(apart) < 0.8 * (z @ z)


def test_the_covariance_has_the_deviations_of_the_intervals_and_the_correlations_of_the_formula():
    rng = np.random.default_rng(3)
    W = rng.normal(size=(200, 6)) @ rng.normal(size=(6, 6))
    Y = W @ np.ones(6) + rng.normal(size=200)
    fit = ordinary_least_squares(System.whole(W, Y, np.zeros(200, dtype=int), tuple("abcdef")))
    found = intervals(fit, Y - W @ fit.beta, 1)
    C = np.linalg.inv(W.T @ W)
    expected = C * np.outer(found.sigma, found.sigma) / np.sqrt(np.outer(np.diag(C), np.diag(C)))
    np.testing.assert_allclose(found.covariance, expected, atol=1e-12 * expected.max())
    exact = intervals(dataclasses.replace(fit, covariance=np.zeros((6, 6))), np.zeros(200), 1)
    np.testing.assert_array_equal(exact.covariance, 0)


# Long recordings


@pytest.mark.parametrize("options", [{"method": "ols"}, {"essential": True}])
def test_a_recording_held_reduced_has_the_intervals_of_its_rows(monkeypatch, options):
    """In blocks that share no boundary with its spans."""
    signals, finely = load_signals(REPLAY / "scara" / "session.mcap"), Overrides(decimation=5)
    whole = identify_ls(signals, finely, **options)
    monkeypatch.setattr("identification.regression.problem._SERIES_BLOCK", 20_000)
    monkeypatch.setattr(regression_module, "_MAX_NUMBERS", 5000)
    reduced = identify_ls(signals, finely, **options)
    assert len(whole.tau) > 8 * MAX_COSINES
    assert reduced.intervals.freedom == whole.intervals.freedom == MAX_COSINES
    apart = np.abs(reduced.intervals.sigma / whole.intervals.sigma - 1)
    # A span's scores count as one instant; a deviation of 16 degrees of freedom spreads by 18 %.
    assert apart.max() < 0.12
    assert np.median(apart) < 0.02
    np.testing.assert_allclose(
        reduced.intervals.low, reduced.beta[reduced.beta != 0] - reduced.intervals.half
    )


def test_spans_of_one_instant_have_the_intervals_of_the_rows():
    """As many instants as spans.

    Joints weighted, rows left out, two recordings, all or some of the parameters.
    """
    T, n, b, rng = SPANS, 2, 4, np.random.default_rng(5)
    rows, spans = [], []
    for _ in range(2):
        W, Y, counts = (
            rng.normal(size=(n, b, T)),
            rng.normal(size=(n, T)),
            rng.uniform(size=(T, n)) > 0.3,
        )
        one = System.whole(
            W.transpose(0, 2, 1).reshape(n * T, b), Y.ravel(), np.repeat([0, 1], T), tuple("abcd")
        )
        one = one.with_rows(counts.T.ravel().astype(float))
        rows.append(dataclasses.replace(one, spans=(Spans(instants=T, count=T),)))
        factors = SpanFactors(T, n)
        for a, z in ((0, 13), (13, 30), (30, 31), (31, T)):
            factors.add(a, np.concatenate([W, Y[:, None]], axis=1)[..., a:z], counts[a:z])
        found, followed = factors.rows()
        spans.append(System(W=found[:, :b], Y=found[:, b], names=tuple("abcd"), **followed))
    of_rows, of_spans = stacked(rows), stacked(spans)
    assert of_spans.spans == 2 * (Spans(instants=T, count=T, rows=1),)
    for columns in (np.arange(4), np.array([1, 3])):
        some, other = of_rows.with_columns(columns), of_spans.with_columns(columns)
        fit, found = weighted_least_squares(some), weighted_least_squares(other)
        np.testing.assert_allclose(found.beta, fit.beta, rtol=1e-9)
        W_w, Y_w = some.weighted(fit.weights)
        wanted, by_spans = (
            intervals(fit, Y_w - W_w @ fit.beta, n, (T, T)),
            intervals_of(other, found),
        )
        np.testing.assert_allclose(by_spans.sigma, wanted.sigma, rtol=1e-9)
        np.testing.assert_allclose(by_spans.low, wanted.low, rtol=1e-9)
        assert by_spans.freedom == wanted.freedom


def test_intervals_of_several_recordings_by_hand():
    """Variances of the recordings' own cosines add up, each over the share of white noise
    that its cosines find.
    """
    parts, n, b, rng = (40, 90), 2, 3, np.random.default_rng(8)
    T = sum(parts)
    W, Y, joint = rng.normal(size=(n * T, b)), rng.normal(size=n * T), np.repeat([0, 1], T)
    fit = ordinary_least_squares(System.whole(W, Y, joint, tuple("abc")))
    rho = Y - W @ fit.beta
    found = intervals(fit, rho, n, parts)
    time, variance, freedom = np.tile(np.arange(T), n), np.zeros(b), 0
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


def test_spans_are_equal_and_have_the_products_of_their_rows():
    """1010 instants in 120 spans of 8 or 9, brought in pieces that end within a span; the second
    joint feels one column.
    """
    T, n, rng = 1010, 2, np.random.default_rng(9)
    columns, counts = rng.normal(size=(n, 7, T)), rng.uniform(size=(T, n)) > 0.2
    columns[1, [0, 1, 3, 4]] = 0.0
    counts[30:50, 0] = False  # a span may have fewer rows than columns
    factors = SpanFactors(T, n)
    for a, z in ((0, 13), (13, 500), (500, 501), (501, T)):
        factors.add(a, columns[..., a:z], counts[a:z])
    found, followed = factors.rows()
    (spans,) = followed["spans"]
    assert (spans.instants, spans.count, spans.rows) == (T, SPANS, 7)
    assert set(np.diff(spans.edges)) == {8, 9}
    np.testing.assert_array_equal(followed["rows"], counts.sum(axis=0))
    found = found.reshape(n, SPANS, 7, 7)
    for k, (a, z) in enumerate(pairwise(spans.edges)):
        for j in range(n):
            rows = columns[j, :, a:z][:, counts[a:z, j]]
            np.testing.assert_allclose(
                found[j, k].T @ found[j, k], rows @ rows.T, rtol=1e-9, atol=1e-12
            )


def test_a_part_of_the_time_has_its_spans():
    """Of a recording that starts at instant 100: all of it, its first span, and none of it."""
    spans = Spans(instants=10, count=4, rows=3)
    np.testing.assert_array_equal(spans.edges, [0, 3, 5, 8, 10])
    assert spans.between(slice(0, 200), 100) == spans
    assert spans.between(slice(90, 103), 100) == Spans(instants=3, count=1, rows=3)
    assert spans.between(slice(105, 110), 100) == Spans(instants=5, count=2, rows=3)
    assert spans.between(slice(0, 100), 100).count == 0
