"""The trust block: each test against mathematics, and on recordings of the independent simulator with one fault each."""

import re
from dataclasses import replace
from functools import cache
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from fits_of_records import iv_of, ls_of, signals_of
from independent_robots import plant
from independent_simulator import (
    Imperfections,
    described_controller,
    description,
    designed_pd,
    references,
    simulate,
)
from scipy.signal import lfilter

import identification.methods.assess as assess
import identification.regression.system as regression_system
from identification.data.signals import Signals
from identification.estimation import instrumental_variables, intervals
from identification.estimation.diagnostics import autoregression
from identification.estimation.system import System
from identification.methods.fit import Fit
from identification.methods.idim import identify_iv, identify_ls
from identification.methods.iteration import Iteration
from identification.regression.settings import Overrides
from identification.trust import Evidence, Trust, TrustLine
from identification.trust.columns import lacks_of
from identification.trust.held_out import held_out_test
from identification.trust.lines import LEVELS, worst_first
from identification.trust.physical import physical_test
from identification.trust.solution import (
    _whitened,
    contrast_test,
    fixed_point_test,
    halves_test,
    instruments_test,
)

WHITE = Imperfections(encoder_noise=1e-6, torque_noise_percent=2.0)
COARSE = Imperfections(encoder_noise=2e-5, torque_noise_percent=1.0)
OWN = ("fixed point", "physical", "added columns", "held-out blocks", "halves", "ends", "contrast of IV and LS")
OWN += ("instruments", "prewhitened")


@cache
def recorded(name: str, cell: Imperfections = WHITE, fault: str = "") -> Signals:
    """A run of 10 s, of the TX40 of 5 s."""
    toml = REPLAY / name / "robot.toml"
    described = plant(toml)
    controller = designed_pd(described, 10.0, 1000.0) if name == "tx40" else described_controller(described)
    body = plant(toml, tilt_rad=np.deg2rad(3.0) if fault == "tilt of gravity" else 0.0)
    friction = {"asymmetric friction": {"asymmetry": 0.2}, "Stribeck friction": {"stribeck": 0.5}}.get(fault, {})
    body = replace(body, friction=replace(body.friction, **friction))
    cell = replace(cell, drift_percent=30.0 if fault == "drift" else 0.0)
    reference = references(
        described, range(5, 6), duration_s=5.0 if name == "tx40" else 10.0, rate_hz=controller.rate_hz
    )
    runs = simulate(body, controller, reference, cell, seed=5)
    return runs.signals(description(toml, controller if name == "tx40" else None), 0)


def looked_at(method: str, signals: Signals, *, long: bool = False, **overrides) -> tuple[Fit, Evidence]:
    """A fit, and the evidence that its tests looked at; `long`: as of a recording whose rows are not held, in short blocks."""
    seen: list[Evidence] = []
    with pytest.MonkeyPatch.context() as patch:
        made = assess.trust_in
        patch.setattr(assess, "trust_in", lambda evidence: seen.append(evidence) or made(evidence))
        if long:
            patch.setattr(regression_system, "_NUMBERS_IN_MEMORY", 100)
            patch.setattr("identification.regression.problem._SERIES_BLOCK", 60_000)
        if method == "iv":
            fit = identify_iv(signals, Overrides(**overrides), Iteration())
        else:
            fit = identify_ls(signals, Overrides(**overrides), method=method)
    return fit, seen[-1]


@cache
def examined(method: str, name: str, cell: Imperfections = WHITE, fault: str = "") -> tuple[Fit, Evidence]:
    """A fit, and the evidence that its tests looked at."""
    return looked_at(method, recorded(name, cell, fault))


@cache
def examined_as_long(method: str) -> tuple[Fit, Evidence]:
    """The same of the SCARA as of a recording whose rows are not held."""
    return looked_at(method, recorded("scara"), long=True)


# The verdict


def line(level: str, test: str = "a test", caps: bool = False) -> TrustLine:
    return TrustLine(test=test, level=level, value=None, text="", caps=caps)


def test_the_worst_line_is_the_verdict():
    for levels, verdict in (
        (("ok", "cannot tell", "not made"), "trust"),
        (("ok", "caution", "not made"), "caution"),
        (("caution", "do not use", "ok"), "do not use"),
    ):
        trust = worst_first([line(level) for level in levels])
        assert trust.verdict == verdict
        assert [LEVELS.index(x.level) for x in trust.lines] == sorted(LEVELS.index(level) for level in levels)
    assert Trust(lines=(line("not made", caps=True),)).verdict == "caution"
    assert Trust(lines=(line("ok", caps=True),)).verdict == "trust"


@pytest.mark.parametrize("method", ["iv", "wls"])
def test_a_clean_recording_is_not_doubted(method):
    fit, _ = examined(method, "scara")
    lines = {x.test: x for x in fit.trust.lines if x.test in OWN}
    assert set(lines) == set(OWN)
    instrumental = {"contrast of IV and LS", "instruments", "prewhitened"}
    not_made = {test for test, x in lines.items() if x.level == "not made"}
    assert not_made == (set() if method == "iv" else instrumental)
    assert all("not made: least squares has no instruments" in lines[test].text for test in not_made)
    assert {x.level for test, x in lines.items() if test not in not_made} == {"ok"}
    assert fit.distrust == ()


@pytest.mark.parametrize(
    ("below", "level"),
    [
        ({"Fv1": 0.9}, "ok"),
        ({"Fv1": 1.5}, "caution"),
        ({"Fv1": 2.5}, "do not use"),
        ({"Fv1": 1.5, "Fc1": 1.5}, "do not use"),
        ({"Fv1": 1.5, "Fc2": 1.5}, "caution"),
    ],
)
def test_what_resists_may_be_below_zero_by_chance_once_a_joint(below, level):
    """In half-widths of the interval."""
    _, evidence = examined("wls", "scara")
    estimate, half = evidence.estimate, evidence.intervals.half
    beta = estimate.beta.copy()
    for name, times in below.items():
        beta[estimate.names.index(name)] = -times * half[estimate.names.index(name)]
    found = physical_test(replace(evidence, estimate=replace(estimate, beta=beta)))
    assert found.level == level, found.text


def test_the_ways_an_iteration_ends():
    _, evidence = examined("iv", "scara")
    none = fixed_point_test(replace(evidence, fixed_point=False, unconfirmed="status diverged: M"))
    assert (none.level, none.text[:18]) == ("do not use", "status diverged: M")
    assert fixed_point_test(replace(evidence, unconfirmed="status not_confirmed: joint 2")).level == "caution"
    assert fixed_point_test(evidence).level == "ok"


# Added columns


@pytest.mark.parametrize("method", ["iv", "wls"])
def test_a_column_is_solved_with_the_others(method):
    """Coefficient, residual and t are those of the system with one column more, with itself as its instrument."""
    fit, evidence = examined(method, "scara", fault="drift")
    system, n = evidence.observed.system.with_rows(evidence.used), 2
    W, Y = system.weighted(fit.estimate.weights)
    T = len(Y) // n
    (lack,) = (x for x in lacks_of(evidence) if (x.kind, x.where) == ("drift", "of joint shoulder"))
    weight = fit.estimate.weights[0] * evidence.used[:T]
    column = np.r_[np.linspace(0, 1, T) * weight, np.zeros(T)]
    Z = evidence.Z if method == "iv" else system.W
    Z = np.c_[Z * (fit.estimate.weights[system.joint_of_row] * evidence.used)[:, None], column]
    wider = np.c_[W, column]
    solved = np.linalg.solve(Z.T @ wider, Z.T @ Y)
    assert lack.value == pytest.approx(solved[-1], rel=1e-6)
    before, after = Y - W @ fit.estimate.beta, Y - wider @ solved
    assert lack.taken_percent == pytest.approx(100 * (1 - after @ after / (before @ before)), rel=1e-6)
    named = System.whole(wider, Y, system.joint_of_row, (*system.names, "drift"))
    estimate = instrumental_variables(named, Z, np.ones(n))
    sigma = intervals(estimate, Y - wider @ estimate.beta, n).sigma[-1]
    assert lack.t == pytest.approx(estimate.beta[-1] / sigma, rel=1e-6)


@pytest.mark.parametrize("fault", ["asymmetric friction", "drift", "Stribeck friction"])
@pytest.mark.parametrize("method", ["iv", "wls"])
def test_what_the_model_lacks_is_named_first(method, fault):
    found = examined(method, "scara", fault=fault)[0].trust
    told = found.line("added columns")
    assert told.level == "caution"
    assert told.text.startswith(f"{fault} of joint ")
    assert found.verdict != "trust"


def test_a_column_has_the_size_of_the_fault():
    by_joint = {x.where: x for x in lacks_of(examined("iv", "scara", fault="asymmetric friction")[1])}
    assert len(by_joint) > 2
    found = [x.value for x in lacks_of(examined("iv", "scara", fault="asymmetric friction")[1]) if "asym" in x.kind]
    np.testing.assert_allclose(found, [20.0, 20.0], atol=3.0)


def test_a_tilt_of_gravity_is_named_first():
    told = examined("wls", "tx40", fault="tilt of gravity")[0].trust.line("added columns")
    assert told.text.startswith("tilt of gravity about x ")
    assert abs(float(told.text.split()[5])) == pytest.approx(np.deg2rad(3.0), rel=0.1)


def test_a_relative_gain_is_named():
    """The elbow's torque scaled by 1.2: its inertia and friction take that, its share in the shoulder's torque does not."""
    signals = recorded("scara")
    scaled = replace(signals, effort=signals.effort * np.array([1.0, 1.2]))
    told = identify_ls(scaled, Overrides()).trust.line("added columns")
    assert told.level == "caution"
    assert told.text.startswith("relative gain of joint ")


# Other estimates from the same rows


def block_errors(evidence: Evidence, blocks: int) -> tuple[float, float]:
    """Held-out and training error in percent, each block predicted by least squares of the rows of the others."""
    W, Y, used = evidence.rows.W, evidence.rows.Y, evidence.used > 0
    n = evidence.observed.tau.shape[1]
    T = len(Y) // n
    time = np.tile(np.arange(T), n)
    edges = np.linspace(0, T, blocks + 1).round()
    weight = np.where(used, evidence.rows.weight, 1.0)
    Z = W if evidence.Z is None else evidence.Z * evidence.rows.weight[:, None]
    held = trained = 0.0
    for a, b in pairwise(edges):
        inside = (time >= a) & (time < b)
        beta = np.linalg.solve(Z[~inside].T @ W[~inside], Z[~inside].T @ Y[~inside])
        held += np.sum(((Y - W @ beta) / weight)[inside] ** 2)
        trained += np.sum((evidence.rows.rho / weight)[inside] ** 2)
    size = np.sum((Y / weight) ** 2)
    return 100 * np.sqrt(held / size), 100 * np.sqrt(trained / size)


@pytest.mark.parametrize("method", ["iv", "wls"])
def test_held_out_blocks_are_predicted_by_the_fit_of_the_others(method):
    _, evidence = examined(method, "scara")
    held, trained = block_errors(evidence, 5)
    told = held_out_test(evidence)
    assert told.value == pytest.approx(held, rel=1e-6)
    assert f"{held:.3g} % held out, {trained:.3g} % trained" in told.text
    assert [figure.name for figure in told.figures] == [f"block {k}" for k in range(1, 6)]


def test_a_fit_that_does_not_carry_over_is_told():
    """Of 60 parameters, from 2.6 s; physical ones carry over better, where the drive gains let them be found."""
    signals = recorded("tx40", fault="tilt of gravity")
    cut = {name: getattr(signals, name)[:2600] for name in ("t_s", "q", "q_ref", "effort")}
    short = identify_ls(replace(signals, **cut), Overrides()).trust.line("held-out blocks")
    assert short.level == "caution"
    held, trained = (float(x) for x in re.findall(r"([0-9.]+) %", short.text))
    assert held > 1.5 * trained
    assert "take the parameters of --consistent" in short.text
    motors = tuple(
        msgspec.structs.replace(m, effort_unit="A", drive_gain=None, drive_gain_unit=None) for m in signals.robot.motors
    )
    unknown = replace(signals, **cut, robot=replace(signals.robot, motors=motors))
    assert "--consistent" not in identify_ls(unknown, Overrides()).trust.line("held-out blocks").text


def test_halves_differ_where_the_torque_changes_its_scale():
    signals = recorded("scara")
    later = np.where(signals.t_s > signals.t_s[-1] / 2, 1.1, 1.0)[:, None]
    assert (
        identify_ls(replace(signals, effort=signals.effort * later), Overrides()).trust.line("halves").level
        == "caution"
    )
    fit, evidence = examined("wls", "scara")
    assert examined("wls", "scara")[0].trust.line("halves").level == "ok"
    assert ls_of(REPLAY / "tx40" / "session.mcap").trust.line("halves").level == "ok"  # of 60 parameters
    # The statistic from the two halves' own least squares: correlations of the formula, deviations of the cosines by the
    # share of white noise that they find in the residuals, I - W(W'W)⁻¹W' of it.
    rows, n, b = evidence.rows, 2, len(fit.estimate.names)
    T = len(rows.Y) // n
    betas, total = [], np.zeros((b, b))
    for half in (slice(0, round(T / 2)), slice(round(T / 2), T)):
        W, Y = (x.reshape(n, T, -1)[:, half] for x in (rows.W, rows.Y))
        W, Y = W.reshape(-1, b), Y.reshape(-1)
        inverse = np.linalg.inv(W.T @ W)
        beta = inverse @ W.T @ Y
        t = (W * (Y - W @ beta)[:, None]).reshape(n, -1, b).sum(axis=0) @ inverse
        instants, B = len(t), int(np.clip(0.4 * len(t) ** (2 / 3), 4, 16))
        waves = np.cos(np.pi * np.arange(1, B + 1)[:, None] * (np.arange(instants) + 0.5) / instants)
        given, seen = np.zeros(b), np.zeros(b)
        for wave in np.sqrt(2) * waves:
            a = (W @ inverse) * np.tile(wave, n)[:, None]
            given += ((W @ inverse) ** 2).sum(axis=0)
            seen += ((a - W @ (inverse @ (W.T @ a))) ** 2).sum(axis=0)
        sigma = np.sqrt(2 * np.mean((waves @ t) ** 2, axis=0) * given / seen)
        formula = np.sqrt(np.diag(inverse))
        total += inverse * np.outer(sigma / formula, sigma / formula)
        betas.append(beta)
    off = betas[1] - betas[0]
    assert halves_test(evidence).value == pytest.approx(off @ np.linalg.solve(total, off), rel=1e-6)


def test_the_noise_of_an_end_sample_is_told():
    """MATLAB's edge rule leaves the last sample of the torque at full size in the end row."""
    signals, stop = recorded("scara"), examined("wls", "scara")[0].settings.stop
    effort = signals.effort.copy()
    effort[stop - 1] += 2.0
    noisy = replace(signals, effort=effort)
    smooth, raw = (identify_ls(noisy, Overrides(edges=edges)).trust.line("ends") for edges in ("smooth", "matlab"))
    assert smooth.level == "ok"
    assert raw.level == "caution"
    assert raw.value > 4 * smooth.value
    assert 'edges = "smooth"' in raw.text


def test_least_squares_beside_instruments():
    """20 µm of noise bias least squares on the EMPS; where it is reported, that is a reason for caution."""
    fit, evidence = examined("iv", "emps", COARSE)
    biased, of_ls = examined("wls", "emps", COARSE)
    beside = np.abs(fit.least_squares.full.beta - fit.beta) / fit.intervals.sigma
    told = contrast_test(evidence)
    assert (told.level, told.value) == ("ok", pytest.approx(beside.max()))
    with_instruments = contrast_test(replace(of_ls, Z=evidence.Z))
    assert with_instruments.level == "caution"
    assert with_instruments.value > 3
    assert contrast_test(replace(examined("wls", "scara")[1], Z=examined("iv", "scara")[1].Z)).level == "ok"
    unmade = biased.trust.line("contrast of IV and LS")
    assert (unmade.level, unmade.caps) == ("not made", not biased.settings.filtered)
    raw = identify_ls(recorded("scara"), Overrides(cutoff_hz=0.0))
    assert raw.trust.line("contrast of IV and LS").caps
    assert raw.trust.verdict != "trust"
    made = identify_ls(recorded("scara"), Overrides(cutoff_hz=0.0), trust=True)
    assert made.trust.line("contrast of IV and LS").level == "ok"


def test_weak_instruments_and_those_that_are_w():
    _, evidence = examined("iv", "scara")
    levels = {F: instruments_test(replace(evidence, first_stage_F=F)).level for F in (5.0, 50.0, 4e16)}
    assert levels == {5.0: "caution", 50.0: "ok", 4e16: "cannot tell"}
    assert "W itself" in instruments_test(replace(evidence, first_stage_F=4e16)).text


def test_an_autoregression_is_found_despite_gaps():
    rng = np.random.default_rng(2)
    rho = lfilter([1.0], [1.0, -0.7, 0.2], rng.standard_normal(20_000))
    used = (rng.random(20_000) > 0.001).astype(float)
    np.testing.assert_allclose(autoregression(rho * used, 4), [0.7, -0.2, 0.0, 0.0], atol=0.03)


def test_prewhitened_rows_are_those_of_the_filter():
    """W, Y and Z filtered by scipy, rows that follow a gap left out, solved by hand."""
    _, evidence = examined("iv", "scara")
    n, T, order = 2, len(evidence.used) // 2, 12
    system, weight = evidence.observed.system, evidence.estimate.weights[evidence.observed.system.joint_of_row]
    order = min(order, T // 20)
    parts = []
    for j in range(n):
        rows = slice(j * T, (j + 1) * T)
        used = evidence.used[rows]
        taps = np.r_[1.0, -autoregression(evidence.rows.rho[rows] * used, order)]
        counts = lfilter(np.ones(order + 1), [1.0], used) == order + 1
        stack = np.c_[system.W, evidence.Z, system.Y][rows]
        parts.append((lfilter(taps, [1.0], stack, axis=0) * weight[rows, None])[counts])
    W, Z, Y = np.split(np.concatenate(parts), [8, 16], axis=1)
    np.testing.assert_allclose(_whitened(evidence).beta, np.linalg.solve(Z.T @ W, Z.T @ Y)[:, 0], rtol=1e-6)


# Long recordings


@pytest.mark.parametrize("method", ["iv", "wls"])
def test_a_long_recording_is_tested_as_its_rows_are(method):
    """Borders of blocks are off by half a block of 128 at most. By instruments a row or two more count: see `fast_rows`."""
    (fit, evidence), (long, of_blocks) = examined(method, "scara"), examined_as_long(method)
    assert (evidence.observed.reduced, of_blocks.observed.reduced) == (False, True)
    rows = 1e-9 if method == "wls" else 0.01
    told, wanted = (x.trust.line("held-out blocks") for x in (long, fit))
    assert (told.level, told.value) == ("ok", pytest.approx(wanted.value, rel=0.01))
    assert [x.name for x in told.figures] == [x.name for x in wanted.figures]
    for one, other in zip(told.figures, wanted.figures, strict=True):
        assert one.value == pytest.approx(other.value, rel=0.05)
    whole = slice(0, len(evidence.observed.tau))
    assert of_blocks.sums(whole).rho_rho == pytest.approx(evidence.sums(whole).rho_rho, rel=2 * rows)
    told, wanted = (x.trust.line("halves") for x in (long, fit))
    assert (told.level, told.value) == ("ok", pytest.approx(wanted.value, rel=0.2))
    told, wanted = (x.trust.line("ends") for x in (long, fit))
    assert (told.level, told.value) == ("ok", pytest.approx(wanted.value, rel=rows))
    assert method == "iv" or told.text == wanted.text
    np.testing.assert_array_equal(of_blocks.predicted, long.rows.tau_predicted)
    left = (evidence.observed.tau - evidence.predicted).T.reshape(-1) * evidence.rows.weight
    np.testing.assert_allclose(left, evidence.rows.rho, atol=1e-9 * np.abs(evidence.rows.rho).max())


def test_sums_over_blocks_are_those_of_their_rows():
    """Least squares of the blocks' own instants, held out or alone, is that of the rows at these instants."""
    (_, evidence), (fit, long) = examined("wls", "scara"), examined_as_long("wls")
    T, n, b = len(evidence.observed.tau), 2, len(fit.estimate.names)
    for part in (slice(0, round(T / 5)), slice(round(T / 5), round(2 * T / 5)), slice(round(T / 2), T)):
        covered = long.aligned(part)
        assert max(abs(covered.start - part.start), abs(covered.stop - part.stop)) <= T / 256 + 1
        inside = np.zeros((n, T), dtype=bool)
        inside[:, covered] = True
        W, Y = evidence.rows.W[inside.ravel()], evidence.rows.Y[inside.ravel()]
        sums, bread = long.sums(part), long.estimate.bread
        np.testing.assert_allclose(np.linalg.solve(sums.QW, sums.QY), np.linalg.lstsq(W, Y)[0], rtol=1e-7)
        np.testing.assert_allclose(bread @ sums.QQ @ bread.T, bread @ bread.T @ (W.T @ W) @ bread @ bread.T, rtol=1e-7)
        weight = evidence.rows.weight[inside.ravel()]
        assert sums.rows == int((weight > 0).sum())
        per = np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0), 0.0)
        assert sums.tau_tau == pytest.approx(np.sum((evidence.observed.tau.T[inside] * (weight > 0)) ** 2), rel=1e-9)
        off = 0.01 * np.random.default_rng(3).normal(size=b) * np.abs(fit.estimate.beta)
        error = np.sum(((Y - W @ (fit.estimate.beta + off)) * per) ** 2)
        assert sums.error(off) == pytest.approx(error, rel=1e-7)
        assert evidence.sums(covered).error(off) == pytest.approx(error, rel=1e-7)


def test_a_long_recording_that_changes_is_doubted():
    """Torque of the second half 10 % larger; a raw end sample; 60 parameters from 2.6 s."""
    signals, stop = recorded("scara"), examined("wls", "scara")[0].settings.stop
    later = np.where(signals.t_s > signals.t_s[-1] / 2, 1.1, 1.0)[:, None]
    noise = np.zeros_like(signals.effort)
    noise[stop - 1] = 2.0
    raised, noisy = replace(signals, effort=signals.effort * later), replace(signals, effort=signals.effort + noise)
    assert looked_at("wls", raised, long=True)[0].trust.line("halves").level == "caution"
    told, wanted = (looked_at("wls", noisy, long=x, edges="matlab")[0].trust.line("ends") for x in (True, False))
    assert (told.level, told.text) == ("caution", wanted.text)
    signals = recorded("tx40", fault="tilt of gravity")
    short = replace(signals, **{name: getattr(signals, name)[:2600] for name in ("t_s", "q", "q_ref", "effort")})
    told, wanted = (looked_at("wls", short, long=x)[0].trust.line("held-out blocks") for x in (True, False))
    assert (told.level, told.value) == ("caution", pytest.approx(wanted.value, rel=0.1))


@pytest.mark.parametrize("long", [False, True])
def test_a_half_without_motion_of_a_joint_determines_nothing_of_it(long):
    signals = recorded("scara")
    q, middle = signals.q.copy(), len(signals.q) // 2
    q[:middle, 1] = q[middle, 1]
    told = looked_at("wls", replace(signals, q=q), long=long, decimation=10)[0].trust.line("halves")
    assert told.level == "not made"
    assert "a half alone does not determine the parameters" in told.text


def test_sums_that_lost_their_digits_are_not_used():
    """Q'Q of all blocks is 1 and Q'W the inverse of the bread, unless squares are too ill-conditioned."""
    _, long = examined_as_long("wls")
    (blocks,) = long.blocks
    assert long.sums_hold
    for lost in ({"QQ": blocks.QQ * (1 + 1e-5)}, {"QW": blocks.QW * (1 + 1e-5)}):
        ill = replace(long, blocks=(replace(blocks, **lost),))
        for test in (held_out_test, halves_test):
            assert test(ill).level == "not made"
            assert "too ill-conditioned" in test(ill).text


def test_reduced_rows_say_what_cannot_be_tested():
    trust = examined_as_long("iv")[0].trust
    assert {x.test for x in trust.lines if x.level == "not made"} >= {"added columns", "lag", "prewhitened"}
    for test in ("added columns", "prewhitened"):
        assert "rows of a long recording are reduced" in trust.line(test).text
    assert trust.line("physical").level == "ok"


# Tests that cannot be made


def test_one_joint_and_unknown_gains_have_no_relative_gain():
    assert "one joint has no relative gain" in examined("iv", "emps", COARSE)[0].trust.line("added columns").text
    signals = recorded("scara")
    motors = tuple(msgspec.structs.replace(m, drive_gain=None, effort_unit="A") for m in signals.robot.motors)
    in_amperes = replace(signals, robot=replace(signals.robot, motors=motors))
    told = identify_ls(in_amperes, Overrides()).trust.line("added columns")
    assert "relative gains not tried: the drive gains are not known" in told.text


def test_a_short_recording_has_no_halves():
    signals = recorded("tx40", fault="tilt of gravity")
    cut = {name: getattr(signals, name)[4000:4700] for name in ("t_s", "q", "q_ref", "effort")}
    trust = identify_ls(replace(signals, **cut), Overrides(cutoff_hz=0.0)).trust
    assert trust.line("halves").level == "not made"
    assert "record longer" in trust.line("halves").text


# Real recordings


def test_the_real_axis_has_asymmetric_friction(emps):
    for fit in (iv_of(emps), ls_of(emps)):
        told = fit.trust.line("added columns")
        assert fit.trust.verdict == "caution"
        assert told.text.startswith("asymmetric friction of joint axis -18.")
        assert told.value < -15
        cautious = [x.test for x in fit.trust.lines if x.level == "caution" and x.test in OWN]
        assert cautious == ["added columns"]
    asymmetry = next(x for x in signals_of(emps).robot.joints)
    assert asymmetry.friction == "symmetric"
