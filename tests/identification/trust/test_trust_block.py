"""The trust block: each test against mathematics, and on recordings of the independent
simulator with one fault each.
"""

import re
from dataclasses import replace
from functools import cache
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, ROOT
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
from looked_at import looked_at
from scipy.signal import lfilter

from identification.data import Signals
from identification.estimation import (
    FINE_SPANS,
    SPANS,
    autoregression,
    essential_names,
    instrumental_variables,
    intervals_of,
)
from identification.regression import (
    Overrides,
    equation_alone,
    motion_blocks,
    torque_of_recording,
    weights_at,
)
from identification.report import TrustResult
from identification.results import Evidence, identify, identify_ls
from identification.trust import (
    LEVELS,
    WORDS,
    Trust,
    TrustInputs,
    candidates,
    kinds,
    trust_in,
)
from identification.trust.columns import missing_terms
from identification.trust.solution import (
    essential_test,
    fixed_point_line,
    halves_test,
    instruments_test,
)
from identification.trust.verdict import worst_first

WHITE = Imperfections(encoder_noise=1e-6, torque_noise_percent=2.0)
COARSE = Imperfections(encoder_noise=2e-5, torque_noise_percent=1.0)
OF_ALL = {
    "convergence",
    "physical plausibility",
    "units",
    "delay",
    "control law",
    "missing terms",
    "cross-validation",
}
OF_ALL |= {"first against second half", "outliers", "physically consistent"}
OF_ALL |= {"essential", "excitation"}


@cache
def recorded(name: str, cell: Imperfections = WHITE, fault: str = "") -> Signals:
    toml, arm = REPLAY / name / "robot.toml", name == "tx40"
    described = plant(toml)
    controller = designed_pd(described, 10.0, 500.0) if arm else described_controller(described)
    body = plant(toml, tilt_rad=np.deg2rad(3.0) if fault == "base tilt" else 0.0)
    friction = {
        "asymmetric friction": {"asymmetry": 0.2},
        "Stribeck friction": {"stribeck": 0.5},
    }.get(fault, {})
    body = replace(body, friction=replace(body.friction, **friction))
    cell = replace(cell, drift_percent=30.0 if fault == "drift" else 0.0)
    reference = references(
        described,
        range(5, 6),
        duration_s={"scara": 7.0, "emps": 6.0, "tx40": 5.0}[name],
        rate_hz=controller.rate_hz,
    )
    runs = simulate(body, controller, reference, cell, seed=5, substeps=1)
    return runs.signals(description(toml, controller if arm else None), 0)


def cut(signals: Signals, first: int, last: int) -> Signals:
    return replace(
        signals,
        **{name: getattr(signals, name)[first:last] for name in ("t_s", "q", "q_ref", "effort")},
    )


def without_gains(signals: Signals, unit: str = "A") -> Signals:
    keys = {"drive_gain": None, "drive_gain_unit": None, "effort_unit": unit}
    motors = tuple(msgspec.structs.replace(m, **keys) for m in signals.robot.motors)
    return replace(signals, robot=replace(signals.robot, motors=motors))


@cache
def examined(
    method: str, name: str, cell: Imperfections = WHITE, fault: str = "", by: str = "spans"
) -> tuple[Evidence, TrustInputs]:
    return looked_at(method, recorded(name, cell, fault), by)


# Data and what is known weigh a little differently in the lag of instruments by spans.
REL = {"iv": 1e-4, "wls": 1e-6}


# The verdict


def line(level: str, test: str = "a test", finding: str = "") -> TrustResult:
    return TrustResult(test=test, level=level, value=None, text="", finding=finding)


def test_worst_line_is_verdict():
    for levels, verdict in (
        (("ok", "inconclusive", "skipped"), "trust"),
        (("ok", "caution", "skipped"), "caution"),
        (("caution", "do not use", "ok"), "do not use"),
    ):
        trust = Trust(lines=worst_first([line(level) for level in levels]))
        assert trust.verdict == verdict
        assert [LEVELS.index(x.level) for x in trust.lines] == sorted(
            LEVELS.index(level) for level in levels
        )


@pytest.mark.parametrize("method", ["iv", "wls"])
def test_clean_recording_is_trusted(method):
    """Least squares cannot find the lag, and half a millisecond more or less is much of the
    shoulder's small friction.
    """
    fit, _ = looked_at(method, recorded("scara"), torque_lag_s=None if method == "iv" else -0.5e-3)
    lines = {x.test: x for x in fit.trust.lines}
    assert set(lines) == OF_ALL | ({"instruments"} if method == "iv" else {"noise bias"})
    assert {x.level for x in lines.values()} == {"ok"}
    assert fit.trust.verdict == "trust"
    assumed = {one.what: one for one in fit.trust.assumed}
    both = {
        "drive gains",
        "efforts",
        "gear ratios",
        "link lengths",
        "sample rate",
        "joint zeros",
        "rotor inertias",
    }
    assert set(assumed) == (both if method == "iv" else both | {"encoder noise", "delay"})
    assert assumed["sample rate"].value == "1000 Hz"
    assert all(one.value and one.why for one in assumed.values())


def test_shared_parameters_need_known_gains():
    fit = identify(without_gains(recorded("scara")), Overrides(), method="wls")
    assert (fit.trust.verdict, fit.trust.lines[0].finding) == (
        "do not use",
        "drive gains not known",
    )
    assert fit.trust.line("units").text.startswith("ZZ2, MX2, MY2 act at several joints")
    told = fit.trust.line("missing terms").text
    assert "relative gains not tried, because the drive gains are not known" in told
    alone = identify(without_gains(recorded("emps"), "V"), Overrides(), method="wls").trust
    assert alone.line("units").level == "ok"
    assert "one joint has no relative gain" in alone.line("missing terms").text


def test_negative_inertia_and_held_out_error(monkeypatch):
    _, evidence = examined("wls", "scara")
    held, law = (trust_in(evidence).line(test) for test in ("cross-validation", "control law"))
    far = msgspec.structs.replace(held, level="caution", case="far off")
    for value, line_, level in (
        (-0.1, far, "do not use"),
        (0.1, far, "caution"),
        (-0.1, held, "ok"),
    ):
        physical = TrustResult(test="physical plausibility", level="caution", text="", value=value)
        rows = {
            made.test: replace(WORDS[made.test], by=lambda _, made=made: made)
            for made in (physical, law, line_)
        }
        monkeypatch.setattr("identification.trust.verdict.WORDS", rows)
        judged = trust_in(evidence).line("cross-validation")
        assert judged.level == level
        assert ("--consistent" in judged.advice) == (level == "do not use")


def test_guide_gives_number_of_time_blocks():
    method = (ROOT / "identification" / "docs" / "method.md").read_text()
    counts = re.findall(r"t counts [a-z ]+: (\d+) of a recording", method)
    assert counts == [str(FINE_SPANS)]


def test_uncertain_inertia_is_caution():
    _, evidence = examined("wls", "scara")
    # as with --essential
    of_some = replace(evidence, estimate=evidence.estimate.part(np.arange(5)))
    assert (essential_test(of_some).level, essential_test(of_some).text) == (
        "ok",
        f"{len(evidence.essential)} of 8 well determined",
    )
    told = essential_test(replace(evidence, essential=("Fv1", "Fc1", "Fc2")))
    assert (told.level, told.finding) == ("caution", "no inertia is precise")
    fit, _ = examined("wls", "scara")
    assert set(fit.essential_names) <= set(fit.essential.names)
    wide = replace(
        fit.intervals,
        low=fit.intervals.low - np.abs(fit.beta),
        high=fit.intervals.high + np.abs(fit.beta),
    )
    assert essential_names(fit.essential, fit.estimate, wide) == ()


def test_error_is_behind_the_default_filter():
    """Noise of 20 µm makes the prediction of a fit without a filter useless; the
    model is none the worse.
    """
    noisy = recorded("emps", COARSE)
    plain, raw = (
        identify(noisy, Overrides(cutoff_hz=c)).errors[-1].relative_error_percent
        for c in (None, 0.0)
    )
    assert raw == pytest.approx(plain, rel=0.3)


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
def test_friction_below_zero_counts_by_joint(below, level):
    _, evidence = examined("wls", "scara")
    estimate, half = evidence.estimate, evidence.intervals.half
    beta = estimate.beta.copy()
    for name, times in below.items():
        beta[estimate.names.index(name)] = -times * half[estimate.names.index(name)]
    found = trust_in(replace(evidence, estimate=replace(estimate, beta=beta))).line(
        "physical plausibility"
    )
    assert found.level == level, found.text


def test_ols_signs_are_tested_with_weights():
    """Of the rows as they are, and with the sign of every torque changed;
    beta of one or the other.
    """

    def judged(method: str, sign_of_beta: int) -> tuple[str, bool]:
        _, evidence = examined(method, "scara")
        observed, estimate = evidence.observed, evidence.estimate
        wrong = replace(observed, system=replace(observed.system, Y=-observed.system.Y))
        estimate = replace(estimate, beta=sign_of_beta * estimate.beta)
        found = trust_in(replace(evidence, observed=wrong, estimate=estimate)).line(
            "physical plausibility"
        )
        return found.level, "by weighted least squares" in found.text

    assert judged("ols", 1) == ("do not use", True)
    assert [judged("ols", -1), judged("wls", 1)] == [("do not use", False), ("ok", False)]


def test_endings_of_the_passes():
    none = fixed_point_line("diverged", "M", gains=False)
    assert (none.level, none.text[:18]) == ("do not use", "status diverged: M")
    lines = [
        fixed_point_line("not_confirmed", "joint 2", gains=False),
        fixed_point_line("not_confirmed", "M", gains=True),
        fixed_point_line("converged", None, gains=False),
    ]
    assert [line.level for line in lines] == ["caution", "caution", "ok"]
    assert "Record the reference" in lines[1].advice


# Added columns


@pytest.mark.parametrize("method", ["iv", "wls"])
def test_added_column_is_solved_with_the_others(method, monkeypatch):
    """By the rows of its instants, with what the rows of spans of time give."""
    fit, evidence = examined(method, "scara", fault="drift", by="instants")
    system = evidence.observed.system
    W, Y = system.weighted(fit.estimate.weights)

    lack, by_spans = (
        next(x for x in missing_terms(one) if (x.kind, x.where) == ("drift", "of joint shoulder"))
        for one in (evidence, examined(method, "scara", fault="drift")[1])
    )
    decimation = evidence.problem.settings.decimator
    motion = next(motion_blocks(evidence.problem))
    if method == "iv":
        motion = fit.recordings[0].simulated.motion
        decimation = replace(decimation, factor=round(len(motion.q) / len(fit.tau)))
    drift = np.linspace(0, 1, len(motion.q))[:, None] * [1.0, 0.0]
    column = decimation.filtered(weights_at(evidence.problem, motion.t_s) * drift.T)
    column = column.reshape(-1)[evidence.observed.counts.T.ravel()] * fit.estimate.weights[0]
    Z = np.c_[evidence.Z * fit.estimate.weights[system.joint_of_row][:, None], column]
    wider = np.c_[W, column]
    solved = np.linalg.solve(Z.T @ wider, Z.T @ Y)
    before, after = Y - W @ fit.estimate.beta, Y - wider @ solved
    taken = 100 * (1 - after @ after / (before @ before))
    for found, rel in ((lack, 1e-6), (by_spans, REL[method])):
        wanted = pytest.approx(solved[-1], rel=rel), pytest.approx(taken, rel=rel)
        assert (found.value, found.taken_percent) == wanted
    named = replace(system, W=wider, Y=Y, names=(*system.names, "drift"))
    estimate = instrumental_variables(named, Z, np.ones(2))
    monkeypatch.setattr("identification.estimation.confidence.NORMAL_REACH", 0.0)
    sigma = intervals_of(named, estimate).sigma[-1]
    assert lack.t == pytest.approx(estimate.beta[-1] / sigma, rel=1e-6)
    assert by_spans.t == pytest.approx(lack.t, rel=0.1)


@pytest.mark.parametrize(
    ("method", "fault"),
    [("iv", "asymmetric friction"), ("wls", "drift"), ("wls", "Stribeck friction")],
)
def test_missing_term_named_first(method, fault):
    found = examined(method, "scara", fault=fault)[0].trust
    told = found.line("missing terms")
    assert (told.level, found.verdict) == ("caution", "caution")
    assert told.text.startswith(f"{fault} of joint ")


def test_coefficient_is_the_size_of_the_fault():
    found = [
        x
        for x in missing_terms(examined("iv", "scara", fault="asymmetric friction")[1])
        if "asym" in x.kind
    ]
    assert [x.where for x in found] == ["of joint shoulder", "of joint elbow"]
    assert [abs(x.value - 20.0) < 3 * x.value / x.t < 15.0 for x in found] == [True, True]


def test_gravity_tilt_named_first():
    told = examined("wls", "tx40", fault="base tilt")[0].trust.line("missing terms")
    assert told.text.startswith("base tilt about x ")
    assert abs(float(told.text.split()[4].strip("("))) == pytest.approx(np.deg2rad(3.0), rel=0.1)


def test_relative_gain_named():
    """The elbow's torque scaled by 1.2: its inertia and friction take that, its share in the
    shoulder's torque does not.
    """
    signals = recorded("scara")
    scaled = replace(signals, effort=signals.effort * np.array([1.0, 1.2]))
    told = identify_ls(scaled, Overrides()).trust.line("missing terms")
    assert (told.level, told.text[:23]) == ("caution", "relative gain of joint ")


def test_two_phases_of_a_fault_count_together(monkeypatch):
    """Two phases of one fault: a ripple of the elbow, which neither phase explains alone."""
    signals = recorded("scara")
    phase = 20 * signals.q[:, 1]
    ripple = 3.0 * (np.cos(phase) + np.sin(phase))
    two = (
        kinds.Kind(
            name="ripple",
            torque=lambda of, x, *_, turn=turn: turn(20 * x.q),
            unit="{effort}",
            advice="",
        )
        for turn in (np.cos, np.sin)
    )
    monkeypatch.setattr(candidates, "KINDS", (*candidates.KINDS, *two))
    fit = identify_ls(
        replace(signals, effort=signals.effort + ripple[:, None] * [0.0, 1.0]), Overrides()
    )
    found = [x for x in missing_terms(fit.data) if x.finding == "ripple of joint elbow missing"]
    assert len({x.column for x in found}) == 2
    assert found[0].together_percent == found[1].together_percent
    assert found[0].together_percent > 1.5 * max(x.taken_percent for x in found)
    assert [x.value for x in found] == pytest.approx([3.0, 3.0], rel=0.6)


# Other estimates from the same rows


def block_errors(method: str, blocks: int) -> tuple[float, float]:
    _, evidence = examined(method, "scara", by="instants")
    W, Y, T = evidence.W, evidence.Y, len(evidence.observed.tau)
    time = evidence.observed.system.span
    Z = evidence.Z * evidence.weight[:, None]
    betas = []
    for a, b in pairwise(np.ceil(np.arange(blocks + 1) * T / blocks)):
        inside = (time >= a) & (time < b)
        betas.append(np.linalg.solve(Z[~inside].T @ W[~inside], Z[~inside].T @ Y[~inside]))
    sets = betas, [evidence.estimate.beta]
    equation = equation_alone(evidence.problem.for_errors)
    tau, (held, trained), counts, *_ = torque_of_recording(*equation, *sets)
    return tuple(
        100 * np.linalg.norm((tau - x)[counts]) / np.linalg.norm(tau[counts])
        for x in (held, trained)
    )


@pytest.mark.parametrize("method", ["iv", "wls"])
def test_blocks_are_predicted_by_the_others(method):
    held, trained = block_errors(method, 5)
    whole, spans = examined(method, "scara", by="instants")[0], examined(method, "scara")[0]
    for fit, rel in ((whole, 1e-6), (spans, REL[method])):
        told = fit.trust.line("cross-validation")
        assert told.value == pytest.approx(held, rel=rel)
        assert f"{held:.3g} % held out, {trained:.3g} % fitted" in told.text
        assert [name for name, *_ in told.figures] == [f"block {k}" for k in range(1, 6)]


def test_overfitted_fit_is_caution():
    """Of 60 parameters, from 2.6 s; physical ones generalise better, where the drive
    gains let them be found.
    """
    signals = cut(recorded("tx40", fault="base tilt"), 0, 1300)
    short = identify_ls(signals, Overrides()).trust.line("cross-validation")
    assert (short.level, "use the parameters of --consistent" in short.advice) == ("caution", True)
    held, trained = (float(x) for x in re.findall(r"([0-9.]+) %", short.text))
    assert held > 1.5 * trained
    unknown = identify_ls(without_gains(signals), Overrides()).trust
    assert "--consistent" not in unknown.line("cross-validation").advice


def test_halves_show_a_change_of_torque_scale():
    signals = recorded("scara")
    later = np.where(signals.t_s > signals.t_s[-1] / 2, 1.1, 1.0)[:, None]
    changed = identify_ls(replace(signals, effort=signals.effort * later), Overrides())
    assert changed.trust.line("first against second half").level == "caution"
    # of 60 parameters
    assert (
        ls_of(REPLAY / "tx40" / "session.mcap").trust.line("first against second half").level
        == "ok"
    )
    fit, evidence = examined("wls", "scara")
    assert fit.trust.line("first against second half").level == "ok"
    of_instants = examined("wls", "scara", by="instants")[1]
    for one, count in ((evidence, SPANS), (of_instants, len(evidence.observed.tau))):
        assert halves_test(one).value == pytest.approx(wald_of_halves(count), rel=1e-6)


def wald_of_halves(count: int) -> float:
    """The statistic from the two halves' own least squares, with scores of `count` spans.

    Correlations of the formula, deviations of the cosines by the share of white noise that
    they find in the residuals, I - W(W'W)⁻¹W' of it.
    """
    _, evidence = examined("wls", "scara", by="instants")
    T, b = len(evidence.observed.tau), len(evidence.estimate.names)
    betas, total = [], np.zeros((b, b))
    span = evidence.observed.system.span * count // T
    middle = count // 2 if count < T else round(T / 2)
    for first, last in ((0, middle), (middle, count)):
        half = (span >= first) & (span < last)
        W, Y, place = evidence.W[half], evidence.Y[half], span[half] - first
        inverse = np.linalg.inv(W.T @ W)
        beta = inverse @ W.T @ Y
        t = np.zeros((last - first, b))
        np.add.at(t, place, (W * (Y - W @ beta)[:, None]) @ inverse)
        instants = np.sum((np.arange(T) * count // T >= first) & (np.arange(T) * count // T < last))
        B = int(np.clip(0.4 * instants ** (2 / 3), 4, 16))
        waves = np.cos(np.pi * np.arange(1, B + 1)[:, None] * (np.arange(len(t)) + 0.5) / len(t))
        given, seen = np.zeros(b), np.zeros(b)
        for wave in np.sqrt(2) * waves:
            a = (W @ inverse) * wave[place][:, None]
            given += ((W @ inverse) ** 2).sum(axis=0)
            seen += ((a - W @ (inverse @ (W.T @ a))) ** 2).sum(axis=0)
        sigma = np.sqrt(2 * np.mean((waves @ t) ** 2, axis=0) * given / seen)
        formula = np.sqrt(np.diag(inverse))
        total += inverse * np.outer(sigma / formula, sigma / formula)
        betas.append(beta)
    off = betas[1] - betas[0]
    return off @ np.linalg.solve(total, off)


def test_outlier_at_an_end_is_reported():
    """MATLAB's edge rule leaves the last sample of the torque at full size in the end row."""
    signals = recorded("scara")
    stop = examined("wls", "scara")[0].settings.stop
    effort = signals.effort.copy()
    effort[stop - 1] += 2.0
    noisy = replace(signals, effort=effort)
    fits = (
        identify_ls(noisy, Overrides(edges=edges, torque_lag_s=0.0))
        for edges in ("smooth", "matlab")
    )
    smooth, raw = (fit.trust.line("outliers") for fit in fits)
    assert (smooth.level, raw.level) == ("ok", "caution")
    assert raw.value > 4 * smooth.value


def test_bias_of_least_squares_is_reported():
    """20 µm on the EMPS, with the controller in the loop: the mass is 20 to 40 % too low."""
    fit, _ = examined("wls", "emps", COARSE)
    told = fit.trust.line("noise bias")
    assert (told.level, fit.trust.verdict) == ("caution", "caution")
    assert told.value > 1
    by_iv, _ = examined("iv", "emps", COARSE)
    assert by_iv.contrast[0] > 1
    assert examined("wls", "emps")[0].trust.line("noise bias").level == "ok"
    for cutoff_hz in (0.0, 350.0):
        unseen = identify_ls(recorded("emps"), Overrides(cutoff_hz=cutoff_hz)).trust.line(
            "noise bias"
        )
        assert unseen.level == "inconclusive"


def test_coloured_noise_seen_by_spectrum():
    """AR(0.9) from sample to sample: the noise above the low-pass is a small
    part of the noise below.
    """
    cell = replace(COARSE, encoder_noise=1e-5, encoder_correlation=0.9)
    fit, _ = examined("wls", "emps", cell)
    assert fit.trust.line("noise bias").level == "caution"


def test_bias_grows_with_the_square_of_noise():
    """What moves the estimate with the noise itself would grow with its deviation."""
    fits = (
        examined("wls", "emps", replace(COARSE, encoder_noise=noise))[0] for noise in (6e-6, 2e-5)
    )
    told = [fit.trust.line("noise bias").text for fit in fits]
    small, large = (float(re.search(r"\(([0-9.]+) %\)", text)[1]) for text in told)
    assert large / small == pytest.approx(100 / 9, rel=0.25)


def test_without_noise_there_is_no_bias(monkeypatch):
    """The lag is that of the described law, which the recording is also fitted with."""
    noise = "identification.methods.solution._noise_like"
    monkeypatch.setattr(noise, lambda problem: np.zeros((1, 1)))
    assert (
        identify_ls(signals_of(REPLAY / "emps" / "session.mcap"), Overrides())
        .trust.line("noise bias")
        .value
        < 1e-9
    )


def test_instruments_are_weak_or_the_regressor():
    _, evidence = examined("iv", "scara")
    lines = [instruments_test(replace(evidence, first_stage_F=F)) for F in (5.0, 50.0, 4e16)]
    assert [line.level for line in lines] == ["caution", "ok", "inconclusive"]
    assert "regressor matrix itself" in lines[-1].text


def test_autoregression_found_despite_gaps():
    rng = np.random.default_rng(2)
    rho = lfilter([1.0], [1.0, -0.7, 0.2], rng.standard_normal(20_000))
    used = (rng.random(20_000) > 0.001).astype(float)
    np.testing.assert_allclose(autoregression(rho * used, 4), [0.7, -0.2, 0.0, 0.0], atol=0.03)


# Rows of spans of time


@pytest.mark.parametrize("method", ["iv", "wls"])
def test_spans_of_time_tell_what_instants_do(method):
    (fit, evidence), (whole, of_instants) = (
        examined(method, "scara"),
        examined(method, "scara", by="instants"),
    )
    T = len(whole.tau)
    for one, count in ((evidence, SPANS), (of_instants, T)):
        (spans,) = one.observed.system.spans
        assert (spans[-1], len(spans)) == (T, count + 1)
    for test, rel in (
        ("cross-validation", REL[method]),
        ("first against second half", 0.2),
        ("outliers", 10 * REL[method]),
        ("missing terms", 0.05),
    ):
        told, wanted = (x.trust.line(test) for x in (fit, whole))
        assert (told.level, told.value) == (wanted.level, pytest.approx(wanted.value, rel=rel))
        figures, same = ([x for _, x, *_ in line.figures] for line in (told, wanted))
        assert test != "cross-validation" or figures == pytest.approx(same, rel=10 * REL[method])
    made, wanted = (
        [x.test for x in one.trust.lines if x.level == "skipped"] for one in (fit, whole)
    )
    assert (made, fit.trust.verdict) == (wanted, whole.trust.verdict)
    lag, other = fit.data.lags[0], whole.data.lags[0]
    assert lag.value_s == pytest.approx(other.value_s, abs=2e-5)
    moved, wanted = (x.moved / x.sd_s for x in (lag, other))
    np.testing.assert_allclose(moved, wanted, rtol=10 * REL[method], atol=1e-4 * wanted.max())
    np.testing.assert_allclose(fit.intervals.sigma, whole.intervals.sigma, rtol=0.15)


def test_sums_of_spans_are_those_of_instants():
    (_, evidence), (fit, by_spans) = (
        examined("wls", "scara", by="instants"),
        examined("wls", "scara"),
    )
    T, b = len(evidence.observed.tau), len(fit.estimate.names)
    for first, last in ((0, round(T / 5)), (round(T / 5), round(2 * T / 5)), (round(T / 2), T)):
        part = by_spans.between(first, last)
        covered = np.repeat(part, by_spans.lengths)
        start, stop = np.flatnonzero(covered)[[0, -1]] + [0, 1]
        assert covered.sum() == stop - start
        assert max(abs(start - first), abs(stop - last)) <= 1
        np.testing.assert_array_equal(evidence.between(start, stop), covered)
        inside = covered[evidence.observed.system.span]
        W, Y = evidence.W[inside], evidence.Y[inside]
        rows, bread = part[by_spans.observed.system.span], by_spans.estimate.bread
        Q, W_k, Y_k = (x[rows] for x in (by_spans.estimate.Q, by_spans.W, by_spans.Y))
        np.testing.assert_allclose(
            np.linalg.solve(Q.T @ W_k, Q.T @ Y_k), np.linalg.lstsq(W, Y)[0], rtol=1e-7
        )
        np.testing.assert_allclose(
            bread @ Q.T @ Q @ bread.T, bread @ bread.T @ (W.T @ W) @ bread @ bread.T, rtol=1e-7
        )
        assert by_spans.count(part) == pytest.approx(
            np.sum(evidence.observed.share[covered] ** 2), rel=1e-9
        )
        beta = fit.estimate.beta * (1 + 0.01 * np.random.default_rng(3).normal(size=b))
        error = np.linalg.norm((Y - W @ beta) / evidence.weight[inside])
        assert by_spans.error(part, beta) == pytest.approx(error, rel=1e-7)
        assert evidence.error(covered, beta) == pytest.approx(error, rel=1e-7)


@pytest.mark.parametrize("by", ["spans", "instants"])
def test_resting_half_determines_nothing(by):
    signals = recorded("scara")
    q, middle = signals.q.copy(), len(signals.q) // 2
    q[:middle, 1] = q[middle, 1]
    fit, _ = looked_at("wls", replace(signals, q=q), by, decimation=10)
    told = fit.trust.line("first against second half")
    assert (told.level, "a half alone" in told.text) == ("skipped", True)


# Tests that cannot be made


def test_short_recording_has_no_halves():
    short = cut(recorded("tx40", fault="base tilt"), 2000, 2350)
    told = identify_ls(short, Overrides(cutoff_hz=0.0)).trust.line("first against second half")
    assert (told.level, "Record longer" in told.advice) == ("skipped", True)


# Real recordings


def test_real_axis_has_asymmetric_friction(emps):
    for fit in (iv_of(emps), ls_of(emps)):
        told = fit.trust.line("missing terms")
        assert fit.trust.verdict == "caution"
        assert told.text.startswith("asymmetric friction of joint axis (-1")
        assert told.value < -15
        cautious = [x.test for x in fit.trust.lines if x.level == "caution"]
        assert cautious == ["missing terms"]
    assert signals_of(emps).robot.joints[0].friction == "symmetric"
