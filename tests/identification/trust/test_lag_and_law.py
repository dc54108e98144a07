"""Lag of the torque and control law, on recordings of the independent
simulator and the real EMPS.
"""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, robot_named
from hunt import fit_by_default, fit_by_least_squares
from hunt_kinds import sound
from independent_robots import plant
from independent_simulator import Imperfections, described_controller, references, simulate
from looked_at import looked_at

from identification.control import law_of
from identification.data import Recordings, Signals, load_signals
from identification.estimation import SpanRows
from identification.methods.iteration import with_lags_found
from identification.regression import Overrides, make_problem, motion_blocks, sampled_at
from identification.regression.lag import LAG_ORDERS, LagFilters
from identification.report import TrustResult
from identification.results import Evidence, identify, identify_ls
from identification.trust import trust_in


@cache
def recorded(
    name: str, lag: int = 0, noise: float = 0.0, stribeck: float = 0.0, seconds: float = 7.0
) -> Signals:
    toml = REPLAY / name / "robot.toml"
    body = plant(toml, smooth=0.002)
    body = replace(body, friction=replace(body.friction, stribeck=stribeck))
    cell = Imperfections(lag=lag, encoder_noise=noise, torque_noise_percent=1.0)
    path = references(body, range(1), duration_s=seconds, rate_hz=1000.0)
    runs = simulate(body, described_controller(body), path, cell, substeps=1)
    return runs.signals(robot_named(name), 0, effort_timing="unknown")


@cache
def fitted(
    signals: Signals, *, method: str | None = None, torque_lag_s: float | str | None = None
) -> Evidence:
    return identify(signals, Overrides(torque_lag_s=torque_lag_s), method=method)


NO_LAW = dict.fromkeys(
    ("structure", "sample_rate_hz", "position_gain", "velocity_gain", "velocity_estimate")
)


def with_controller(signals: Signals, **keys: object) -> Signals:
    robot = signals.robot
    return replace(
        signals, robot=replace(robot, controller=msgspec.structs.replace(robot.controller, **keys))
    )


def late_scara() -> Signals:
    signals = recorded("scara")
    return replace(signals, effort=signals.effort[np.maximum(np.arange(len(signals.q)) - 2, 0)])


# Lag


def known(signals: Signals, option: float | str | None = None) -> tuple[float, float, str]:
    found = make_problem(signals, Overrides(torque_lag_s=option)).settings.known_lag
    return found.value_s, found.sd_s, found.source


@pytest.mark.parametrize(("name", "lag"), [("emps", 3), ("scara", 0)])
def test_delay_found_corrected_and_counted(name, lag):
    signals = recorded(name, lag=lag)
    fit = fitted(signals)
    # By the same ramps: those of a stated lag may be others, just as good.
    stated = identify(
        signals, Overrides(torque_lag_s=1e-3 * (lag - 0.5), ramp_rows=fit.settings.ramp_rows)
    )
    (found,) = fit.data.lags
    assert found.found is not None
    assert 1e3 * found.value_s == pytest.approx(lag - 0.5, abs=0.12)
    assert abs(1e3 * found.value_s - (lag - 0.5)) < 1.5 * 1e3 * found.half_width_s
    assert fit.settings.torque_lag_s == found.value_s
    assert (np.abs(fit.beta - stated.beta) < fit.intervals.half).all()
    wider = np.sqrt(stated.intervals.sigma**2 + found.moved**2)
    np.testing.assert_allclose(fit.intervals.sigma, wider, rtol=0.15)
    told = fit.trust.line("delay")
    assert (told.level, told.value) == ("ok", pytest.approx(1e3 * found.value_s))
    assert "corrected and included in the intervals" in told.text


def test_delay_effect_is_difference_of_two_fits():
    signals = recorded("emps", lag=3)
    by = partial(Overrides, ramp_rows=2.0)
    fits = [identify(signals, by(torque_lag_s=lag_s), method="wls") for lag_s in (-1e-4, 1e-4)]
    lag = identify(signals, by(), method="wls").data.lags[0]
    moves, half = np.abs(fits[1].beta - fits[0].beta) / 2e-4, fits[0].intervals.half
    # Of a millisecond; the fits differ in the weights of their joints too.
    np.testing.assert_array_less(
        1e-3 * np.abs(lag.moved / lag.sd_s - moves), np.maximum(0.2 * half, 2e-5 * moves)
    )


@pytest.mark.parametrize(
    ("cell", "within", "most_ms"),
    [({"lag": 1, "noise": 2e-5}, 1.25, 0.8), ({"stribeck": 0.5}, 1.5, np.inf)],
)
def test_noise_or_missing_friction_is_no_delay(cell, within, most_ms):
    (found,) = fitted(recorded("emps", **cell)).data.lags
    assert found.value_s == pytest.approx(
        (cell.get("lag", 0) - 0.5) * 1e-3, abs=within * found.half_width_s
    )
    assert 1e3 * found.half_width_s < most_ms


def test_delay_step_halved_from_fourth_iteration(monkeypatch):
    """As values do: undamped, a lag may go to and fro for ever. It settles by its whole step, here
    of 0.4 samples.
    """
    before = make_problem(recorded("scara"), Overrides()).settings.known_lag
    found = [replace(before, value_s=1.4e-3)]
    monkeypatch.setattr("identification.methods.iteration.lags_in", lambda *_: found)
    rows = SimpleNamespace(late=(), x=np.array([1.0, 1e-3]), linearised_at=lambda x: x)
    for number, value_s in ((3, 1.4e-3), (4, 1.2e-3)):
        x, (lag,), settled = with_lags_found(rows, [before], number)
        assert (x[-1], lag.value_s, settled) == pytest.approx((value_s, value_s, False))


def test_contradicting_data_count_alone():
    """A torque two samples late that is said to be a mean, without a controller to replay."""
    signals = replace(late_scara(), effort_timing="mean")
    fit = fitted(with_controller(signals, **NO_LAW, bandwidth_hz=signals.robot.bandwidth_hz))
    (found,) = fit.data.lags
    assert (found.source, 1e3 * found.value_s) == ("data", pytest.approx(1.5, abs=0.2))
    assert "which differs significantly and is not used" in fit.trust.line("delay").text


def test_data_beside_given_delay():
    late = recorded("emps", lag=3)
    fit = fitted(late, method="wls", torque_lag_s=0.0025)
    assert (fit.trust.line("delay").level, fit.settings.torque_lag_s) == ("ok", 0.0025)
    assert "delay" in [one.what for one in fit.trust.assumed]
    wrong = fitted(late, torque_lag_s=0.002).trust.line("delay")
    assert (wrong.level, "the data show 0.002" in wrong.text) == ("caution", True)


def test_lag_without_reference_widens_intervals():
    bare = replace(recorded("scara"), q_ref=None)
    fit = identify(bare, Overrides())
    (found,) = fit.data.lags
    assert (fit.method, found.found, found.value_s, found.sd_s) == ("wls", None, 0.0, 0.002)
    assert fit.trust.line("delay").text.startswith("not known, 0 ± 2 ms: ±")
    exact = fitted(bare, method="wls", torque_lag_s=0.0)
    half = fit.intervals.reach * np.hypot(exact.intervals.sigma, found.moved)
    np.testing.assert_allclose(fit.intervals.half, half, rtol=1e-9)
    assert identify(bare, Overrides(), method="iv").data.lags[0].found is None


def test_command_delay_and_early_torque():
    signals = recorded("scara")
    assert fitted(signals).data.lags[0].delay_s == pytest.approx((0.0, 0.0), abs=2.5e-4)
    _, evidence = looked_at("iv", signals)
    (lag,) = evidence.lags
    late, early = (
        replace(lag, by_law_s=lag.value_s + by, found=(lag.value_s, 1e-4 / lag.reach, 99))
        for by in (2e-3, -2e-3)
    )
    after, before = (
        trust_in(replace(evidence, lags=(one,))).line("delay") for one in (late, early)
    )
    assert (after.level, before.level) == ("ok", "caution")
    assert "2.00 ± 0.10 samples after the command" in after.text


def test_similar_recordings_share_delay():
    first, second = recorded("scara"), late_scara()
    first = replace(first, recording="A", sha256="a")
    both = Recordings(sources=(first, replace(second, recording="B", sha256="b")))
    (one,) = identify(both, Overrides()).data.lags
    assert one.recordings == ("A", "B")
    slow = replace(
        both.sources[1],
        effort_timing="command",
        sample_rate_hz=500.0,
        **{name: getattr(second, name)[::2] for name in ("t_s", "q", "q_ref", "effort")},
    )
    two = identify(Recordings(sources=(first, slow)), Overrides())
    found = {lag.recordings: 1e3 * lag.value_s for lag in two.data.lags}
    assert found == {("A",): pytest.approx(-0.5, abs=0.2), ("B",): pytest.approx(1.5, abs=0.3)}
    # in samples of its recordings
    assert two.trust.line("delay").value == pytest.approx(0.5 * found[("B",)])


@pytest.mark.parametrize(
    ("timing", "rate_hz", "stated", "option", "expected"),
    [
        ("command", 1000.0, None, None, (-0.5e-3, 0.25e-3, "effort_timing command")),
        ("command", None, None, None, (-0.5e-3, 0.25e-3, "effort_timing command")),
        ("mean", 1000.0, None, None, (0.0, 0.25e-3, "effort_timing mean")),
        ("measured", 1000.0, None, None, (0.0, 0.25e-3, "effort_timing measured")),
        ("unknown", 1000.0, None, None, (0.0, 2e-3, "nothing")),
        ("command", 1000.0, 2e-3, None, (2e-3, 0.0, "torque_lag_s")),
        ("command", 1000.0, 2e-3, "none", (0.0, 0.0, "torque_lag_s")),
        ("unknown", 1000.0, "none", 1e-3, (1e-3, 0.0, "torque_lag_s")),
    ],
)
def test_known_delay(timing, rate_hz, stated, option, expected):
    signals = with_controller(
        replace(recorded("scara"), effort_timing=timing), sample_rate_hz=rate_hz
    )
    own = msgspec.structs.replace(signals.robot.identification, torque_lag_s=stated)
    assert (
        known(replace(signals, robot=replace(signals.robot, identification=own)), option)
        == expected
    )


def test_sine_shift_with_truncated_ends():
    t = np.arange(2000.0)
    x = np.sin(0.05 * t)[:, None]
    np.testing.assert_allclose(
        sampled_at(t[:-10] + 0.3, x)[:, 0], np.sin(0.05 * (t[:-10] + 0.3)), atol=1e-6
    )
    signals = recorded("scara")
    N = len(signals.q)
    for lag_s in (0.9, -0.9):
        settings = make_problem(signals, Overrides(torque_lag_s=lag_s, span="all")).settings
        assert (settings.start >= 900, settings.stop <= N - 900) == (lag_s < 0, lag_s > 0)


@pytest.mark.parametrize("block", [None, 1])
def test_autoregression_removed(block, monkeypatch):
    """Of fast rows that count, with six like them before and behind: the noise that drives it is
    left, within the twentieth of its square that the estimated coefficients change.
    """
    if block:
        monkeypatch.setattr("identification.regression.problem._SERIES_BLOCK", block)
    problem, rng = (
        make_problem(recorded("emps", seconds=10.0), Overrides()),
        np.random.default_rng(1),
    )
    motions = list(motion_blocks(problem))
    assert (len(motions) > 1) == (block is not None)
    speed = np.concatenate([z.kept(z.dq) for z in motions])
    share = np.where(rng.uniform(size=speed.shape) > 0.01, 0.5, 0.0)
    x, e = np.zeros(len(speed)), rng.standard_normal(len(speed))
    for k in range(2, len(x)):
        x[k] = 1.2 * x[k - 1] - 0.5 * x[k - 2] + e[k]
    lag, late, shares = LagFilters(problem, np.array([0]), share, x[:, None], speed), SpanRows(), []
    for z in motions:
        vars(z)["share"] = share[z.near][z.inside].T
        rows, of_lag = lag.whitened(np.outer([2, 1, 3], x[z.near][z.inside])[None], z)
        late.add(SpanRows.of_block(len(x), z.first, rows, of_lag))
        shares.append(of_lag.T)
    white, Z, _ = lag.system(late, np.concatenate(shares), ("lag",))
    np.testing.assert_allclose(Z, 2 * white.W, atol=1e-12)
    np.testing.assert_allclose(white.Y, 3 * white.W[:, 0], atol=1e-12)
    fast = np.abs(speed[:, 0]) > 0.2 * np.abs(speed).max()
    fast = [fast[k : k + 7].all() and share[k, 0] > 0 for k in range(len(x))]
    # six rows of a block, too, have none before them that are known
    first = np.concatenate([np.arange(len(z.share.T)) for z in motions])
    used = [first[k] >= 6 and all(fast[k - 6 : k + 1]) for k in range(len(x))]
    assert white.rows[0] == pytest.approx(0.25 * np.sum(used))
    assert 0.3 * len(x) < np.sum(used) < 0.9 * len(x)
    assert np.linalg.norm(white.Y) ** 2 == pytest.approx(9 * np.sum(e[used] ** 2), rel=0.05)
    assert np.sum(x[used] ** 2) > 2 * np.sum(e[used] ** 2)


def test_reversing_joint_keeps_filter_of_the_others():
    problem = make_problem(recorded("scara"), Overrides())
    share, speed = np.ones((2, 300, 2))
    speed[::3, 1] = 0.0  # the elbow reverses all the time
    x = np.random.default_rng(1).standard_normal((300, 2))
    assert LagFilters(problem, np.array([0]), share, x, speed).order == LAG_ORDERS[0]
    speed[:270:30] = 0.0  # now and then all
    assert LagFilters(problem, np.array([0]), share, x, speed).order == LAG_ORDERS[0]
    speed[::9] = 0.0
    assert LagFilters(problem, np.array([0]), share, x, speed).order < LAG_ORDERS[0]


# Control law


def law_line_of(signals: Signals) -> TrustResult:
    return fitted(signals, method="wls").trust.line("control law")


@pytest.mark.parametrize("name", ["emps", "scara"])
def test_right_controller_confirmed_faults_named(name):
    signals = recorded(name)
    sign = np.ones(signals.robot.n)
    sign[-1] = -1
    ratio = {"q": 1.05 * signals.q, "q_ref": 1.05 * signals.q_ref, "effort": signals.effort / 1.05}
    for one, level, value in (
        (signals, "ok", 1.0),
        (replace(signals, effort=1.1 * signals.effort), "caution", 1.1),
        (replace(signals, **ratio), "caution", 1 / 1.05**2),
        (replace(signals, effort=signals.effort * sign), "do not use", -1.0),
    ):
        line = law_line_of(one)
        assert (line.level, line.value) == (level, pytest.approx(value, abs=0.01))
    assert f"motor {signals.robot.motors[-1].name}:" in line.text


def test_one_percent_rate_error_shows_in_speed_loop():
    signals = recorded("emps")
    found = law_line_of(replace(signals, sample_rate_hz=1010.0, t_s=signals.t_s / 1.01))
    assert found.level == "caution"


def test_missing_integral_found():
    toml = REPLAY / "scara" / "robot.toml"
    body = plant(toml, smooth=0.002)
    c = described_controller(body)
    cascade = {"structure": "cascade_p_pi", "position_gain": c.position_gain / c.velocity_gain}
    c = replace(c, **cascade, integral_gain=np.full(2, 20.0))
    path = references(body, range(1), duration_s=5.0, rate_hz=1000.0)
    runs = simulate(body, c, path, Imperfections(torque_noise_percent=1.0), substeps=1)
    keys = {
        "structure": c.structure,
        "position_gain": tuple(c.position_gain),
        "integral_gain": (20.0, 20.0),
    }
    signals = with_controller(runs.signals(robot_named("scara"), 0), **keys)
    assert law_line_of(signals).level == "ok"
    assert (
        law_line_of(with_controller(signals, structure="cascade_p_p", integral_gain=None)).level
        == "caution"
    )


def test_given_gains_show_delay_of_noisy_commands():
    signals = recorded("emps", lag=1, noise=2e-5)
    law = law_of(make_problem(signals, Overrides()))
    assert law.lag_s[0] * signals.sample_rate_hz == pytest.approx(1.0, abs=0.1)
    assert law.residual_percent[0] < 1.1
    corrected = law_of(make_problem(signals, Overrides(torque_lag_s=0.002)))
    assert corrected.lag_s[0] == pytest.approx(law.lag_s[0], abs=2e-5), (
        "of the effort as it was recorded"
    )


def test_law_not_tested_says_why_found_law_is_used():
    signals = recorded("scara")
    bare = with_controller(signals, **NO_LAW)
    torque = with_controller(signals, structure="computed_torque")
    for one, why in ((replace(signals, q_ref=None), "no reference"), (torque, "own model")):
        found = identify_ls(one, Overrides()).trust.line("control law")
        assert found.level == "skipped"
        assert why in found.text
    fit = identify(bare, Overrides())
    assert (fit.trust.verdict, fit.controller) == ("trust", "found")
    assert not [x for x in fit.trust.assumed if x.what == "control law"]


def test_real_emps(emps):
    """Controller confirmed.

    The volts are 0.75 to 0.8 ms early: half a period of hold, and 0.25 ms of the amplifier.
    """
    fit = identify(load_signals(emps), Overrides())
    found = fit.trust.line("control law")
    assert found.level == "ok"
    assert found.value == pytest.approx(1.0, abs=1e-3)
    (lag,) = fit.data.lags
    assert 1e3 * lag.value_s == pytest.approx(-0.77, abs=0.08)
    assert lag.delay_s is not None
    assert 1e3 * lag.delay_s[0] == pytest.approx(0.27, abs=0.08)


def test_invisible_delay_assumed_with_advice():
    """An axis whose viscous friction a lag of ± 2 ms moves by some half-widths."""
    signals = replace(
        sound("emps", np.random.default_rng(2)), substeps=1, timing="unknown"
    ).recording(2)
    fit = fit_by_default(replace(signals, q_ref=None))
    assert (fit.trust.line("delay").level, fit.trust.verdict) == ("inconclusive", "trust")
    (one,) = (of for of in fit.trust.assumed if of.what == "delay")
    assert one.value == "0 ± 2 ms"
    assert "half-widths at" in one.why
    told = fit_by_least_squares(signals).trust.line("delay")
    known = "by the control law in robot.toml" in told.text
    assert known or (told.level == "caution" and "take --method iv" in told.text), told.text
