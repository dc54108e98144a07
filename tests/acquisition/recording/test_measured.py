"""Rows that nobody measured, found by what they hold: every one of made-up losses, and none of
recordings without a loss, however coarse, slow or free of noise.
"""

import numpy as np
import pytest
from conftest import REPLAY, robot_named
from scipy.interpolate import CubicSpline

from acquisition.recording import in_gaps, measured_rows, read_recording

RATE_HZ, N = 500, 6000
T_S = np.arange(N) / RATE_HZ
STAMPS = np.rint(1e9 * T_S).astype(np.int64)
ARM = robot_named("tx40")  # the motors of joints 5 and 6 are coupled
JOINTS = np.arange(ARM.n)
NONE = np.zeros(N, dtype=bool)


def recorded(seed, *, speed=1.0, noise=1.0):
    """Positions and efforts (N, n) of six joints on sines, friction at their reversals."""
    rng, others = map(np.random.default_rng, (seed, 1000 + seed))
    w = speed * 2 * np.pi * others.uniform(0.2, 0.7, ARM.n)
    phases = rng.uniform(0, 6, ARM.n)
    q, dq = np.sin(np.outer(T_S, w) + phases), w * np.cos(np.outer(T_S, w) + phases)
    effort = 30 * np.sin(q + JOINTS) - 4 * w * q + 6 * np.tanh(dq / 0.01) + 2 * dq
    return (
        q + noise * 1e-5 * rng.normal(size=q.shape),
        effort + noise * 0.2 * rng.normal(size=q.shape),
    )


def judged(stamps, q, u):
    return measured_rows({"stamp_ns": stamps, "position": q, "effort": u}, ARM)


def rows_from(*spans):
    return np.any([(np.arange(N) >= first) & (np.arange(N) < last) for first, last in spans], 0)


def frozen(x, lost):
    """x (N, ...) with the last value before them in rows that were lost."""
    return x[np.maximum.accumulate(np.where(lost, 0, np.arange(N)))]


def with_motors(effort, motors, lost, values):
    """Efforts at the joints where those of some motors are others in the rows `lost`."""
    of_motors = ARM.motor_effort(effort)
    chosen = np.isin(JOINTS, motors)
    return ARM.joint_effort(np.where(lost[:, None] & chosen, values(of_motors), of_motors))


def on_lines(x):
    return np.stack([np.interp(T_S, T_S[~GAPS], own[~GAPS]) for own in x.T], 1)


BURSTS = rows_from(*((k, k + 30) for k in range(250, N, 500)))
LONG = rows_from((2000, 2300))
GAPS = rows_from((1500, 1800), (4000, 4100))
SINGLE = np.isin(np.arange(N), np.random.default_rng(5).choice(N, 60, replace=False))
EVERY_OTHER, EVERY_FIFTH = np.arange(N) % 2 == 0, np.arange(N) % 5 == 0
BUT_SEVENTH = BURSTS & (np.arange(N) % 7 != 0)
OFTEN = np.arange(N) % 100 >= 88
# What becomes of q and u, and the rows that were not measured.
LOSSES = {
    "all zero, in bursts": (lambda q, u: (q, np.where(BURSTS[:, None], 0.0, u)), BURSTS),
    "all zero, single rows": (lambda q, u: (q, np.where(SINGLE[:, None], 0.0, u)), SINGLE),
    "all zero, every other row": (
        lambda q, u: (q, np.where(EVERY_OTHER[:, None], 0.0, u)),
        EVERY_OTHER,
    ),
    "all zero, every fifth row": (
        lambda q, u: (q, np.where(EVERY_FIFTH[:, None], 0.0, u)),
        EVERY_FIFTH,
    ),
    "all zero, but for every seventh": (
        lambda q, u: (q, np.where(BUT_SEVENTH[:, None], 0.0, u)),
        BUT_SEVENTH,
    ),
    "one motor zero, often": (lambda q, u: (q, with_motors(u, [0], OFTEN, np.zeros_like)), OFTEN),
    "efforts filled by lines": (lambda q, u: (q, on_lines(u)), GAPS),
    "all held, in bursts": (lambda q, u: (q, frozen(u, BURSTS)), BURSTS),
    "one motor zero": (lambda q, u: (q, with_motors(u, [1], LONG, np.zeros_like)), LONG),
    "one motor held": (
        lambda q, u: (q, with_motors(u, [3], LONG, lambda x: frozen(x, LONG))),
        LONG,
    ),
    "one coupled motor zero": (lambda q, u: (q, with_motors(u, [5], LONG, np.zeros_like)), LONG),
    "gaps filled by a spline": (
        lambda q, u: tuple(CubicSpline(T_S[~GAPS], x[~GAPS])(T_S) for x in (q, u)),
        GAPS,
    ),
    "gaps filled by lines": (lambda q, u: (on_lines(q), on_lines(u)), GAPS),
}  # fmt: skip


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("loss", LOSSES)
def test_exactly_lost_rows_are_found(loss, seed):
    change, lost = LOSSES[loss]
    q, u = change(*recorded(seed))
    measured, text = judged(STAMPS, q, u)
    np.testing.assert_array_equal(measured, ~lost)
    assert f"{lost.sum()} {'are interpolated' if 'filled' in loss else 'have lost efforts'}" in text


def test_rows_held_over_gap_are_found():
    q, u = (frozen(x, GAPS) for x in recorded(1))
    measured, _ = judged(STAMPS, q, u)
    assert not (measured & rows_from((1500, 1799), (4000, 4099))).any()
    assert measured[~GAPS].all()


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    ("what", "speed", "noise", "q_step", "u_step"),
    [
        ("as it is", 1.0, 1.0, 0, 0),
        ("without noise", 1.0, 0.0, 0, 0),
        ("slow, without noise", 0.02, 0.0, 0, 0),
        ("coarse", 1.0, 1.0, 1e-4, 1.0),
        ("coarse, without noise", 1.0, 0.0, 1e-3, 3.0),
        ("coarse and slow", 0.05, 0.0, 1e-4, 0.5),
    ],
)
def test_no_lost_rows_in_complete_recording(what, speed, noise, q_step, u_step, seed):
    q, u = recorded(seed, speed=speed, noise=noise)
    q, u = (np.round(x / by) * by if by else x for x, by in ((q, q_step), (u, u_step)))
    assert judged(STAMPS, q, u)[1] == ""


def trapezoid(rate_hz, speed, acceleration, period_s):
    """Position, speed and acceleration (N,) of moves to and fro at constant speed."""
    half, rise, t = 0.5 * period_s, speed / acceleration, np.arange(round(10 * rate_hz)) / rate_hz
    way, t = np.where(t % period_s < half, 1, -1), t % half
    a = way * np.where(t < rise, acceleration, np.where(t > half - rise, -acceleration, 0.0))
    v = way * np.clip(acceleration * np.minimum(t, half - t), 0, speed)
    return np.cumsum(v) / rate_hz, v, a


@pytest.mark.parametrize("rate_hz", [100, 1000])
@pytest.mark.parametrize("noise", [0.0, 1e-6])
@pytest.mark.parametrize(("name", "n"), [("emps", 1), ("scara", 2)])
def test_noiseless_constant_efforts_are_measured(name, n, noise, rate_hz):
    """As of a first simulation, of one axis and of two without gravity."""
    moves = [trapezoid(rate_hz, *x) for x in ((0.3, 1.2, 2.0), (0.4, 1.0, 2.5))[:n]]
    q, dq, ddq = np.stack(moves, axis=-1)
    q = q + noise * np.random.default_rng(0).normal(size=q.shape)
    rows = {
        "stamp_ns": np.arange(len(q)) * (1e9 / rate_hz),
        "position": q,
        "effort": 90 * ddq + 200 * dq + 20 * np.sign(dq),
    }
    assert measured_rows(rows, robot_named(name))[1] == ""


@pytest.mark.parametrize("rate_hz", [100, 125, 250])
@pytest.mark.parametrize("speed", [0.1, 0.3])
def test_noiseless_slow_moves_are_measured(rate_hz, speed):
    """At constant speed torques of gravity are cubic for long, to rounding."""
    moves = [trapezoid(rate_hz, speed, 1.5, period_s) for period_s in (5.0, 6.1)]
    q, dq, ddq = np.stack(moves, axis=-1)
    u = 3 * ddq + 2 * dq + np.sign(dq) + 20 * np.sin(q.sum(axis=1, keepdims=True)) * [2, 1]
    rows = {"stamp_ns": np.arange(len(q)) * (1e9 / rate_hz), "position": q, "effort": u}
    assert measured_rows(rows, robot_named("scara"))[1] == ""


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_noiseless_zeros_are_found(seed):
    q, u = recorded(seed, noise=0.0)
    measured, _ = judged(STAMPS, q, np.where(BURSTS[:, None], 0.0, u))
    np.testing.assert_array_equal(measured, ~BURSTS)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 10, 40])
def test_few_rows_are_judged(count):
    q, u = recorded(1)
    assert judged(STAMPS[:count], q[:count], u[:count])[1] == ""
    assert judged(STAMPS[:count], 0 * q[:count], 0 * u[:count])[1] == ""


PAUSED = np.minimum(np.arange(N), np.maximum(2000, np.arange(N) - 300))  # stands for 300 rows


@pytest.mark.parametrize(
    "change",
    [
        lambda q, u: (frozen(q, np.arange(N) % 4 > 0), u),
        lambda q, u: (q, frozen(u, np.arange(N) % 4 > 0)),
        lambda q, u: (q, ARM.joint_effort(np.clip(ARM.motor_effort(u), -0.2, 0.2))),  # limits
        lambda q, u: (q, ARM.joint_effort(np.clip(ARM.motor_effort(u), -0.1, 0.3))),
        lambda q, u: (q[PAUSED], u[PAUSED]),
        lambda q, u: (q, np.where(JOINTS == 2, 0.0, u)),  # never recorded, which is said elsewhere
    ],
)
def test_held_saturated_or_resting_is_measured(change):
    assert judged(STAMPS, *change(*recorded(4)))[1] == ""


@pytest.mark.parametrize("name", ["emps", "scara", "tx40"])
def test_no_lost_rows_in_shipped_sessions(name):
    found = read_recording(REPLAY / name / "session.mcap")
    measured, text = measured_rows(found.samples, found.robot)
    assert measured.all()
    assert text == ""


def test_no_lost_rows_in_real_records(emps, tx40):
    for path in (emps, tx40):
        found = read_recording(path)
        assert measured_rows(found.samples, found.robot)[1] == ""


def test_gaps_and_clock_steps_differ():
    """Of two steps of 0.5 s, rows are missing in one; over the other only the clock goes on."""
    q, u = recorded(6)
    there = ~rows_from((1500, 1750))
    stamps = STAMPS + np.where(np.arange(N) >= 4000, 500_000_000, 0)
    measured, text = judged(stamps[there], q[there], u[there])
    assert measured.all()
    assert "500 are missing in 2 gap(s)" in text
    assert "1 of these gaps are steps of the clock" in text
    grid = np.arange(0.0, 13e9, 2e6)
    inside = in_gaps(stamps[there] - stamps[0], grid)
    np.testing.assert_array_equal(np.flatnonzero(inside), [*range(1500, 1750), *range(4000, 4250)])
