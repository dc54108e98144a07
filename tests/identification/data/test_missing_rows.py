"""Rows that are missing or repeated, by the steps of the positions: told with their share,
and never where none is.
"""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY, robot_named
from fits_of_records import ls_of, signals_of
from hunt_kinds import KINDS, sound
from independent_simulator import with_lost_rows

from identification.data import load_signals, position_steps, signals_from_arrays
from identification.regression import Overrides
from identification.results import identify_ls


def shares(q):
    *found, moving = position_steps(q)[0]
    return 100 * np.array(found) / max(moving, 1)


def drawn(rows, percent):
    at = np.random.default_rng(3).choice(
        np.arange(5, rows - 5, 2), round(0.01 * percent * rows), replace=False
    )
    return np.isin(np.arange(rows), at)


def short(name, seed, duration_s=4.0):
    return replace(sound(name, np.random.default_rng(seed)), duration_s=duration_s, substeps=1)


@pytest.fixture(scope="module")
def q():
    return {name: short(name, 1, 10.0).recording(1).q for name in ("emps", "scara")}


@pytest.mark.parametrize("percent", [0.2, 2.0])
@pytest.mark.parametrize("name", ["emps", "scara"])
def test_share_reported_to_tenth_of_percent(q, name, percent):
    q = q[name]
    chosen = drawn(len(q), percent)
    before = np.where(chosen, np.arange(len(q)) - 1, np.arange(len(q)))
    of_lost, of_repeated, of_held = (
        shares(x) for x in (q[~chosen], np.repeat(q, 1 + chosen, axis=0), q[before])
    )
    assert of_lost == pytest.approx([percent, 0, 0], abs=0.1 + 0.05 * percent)
    assert of_repeated == pytest.approx([0, percent, 0], abs=0.1 + 0.05 * percent)
    assert of_held[2] == pytest.approx(percent, abs=0.1 + 0.15 * percent)
    assert of_held[:2].max() < 0.3 * of_held[2]


@pytest.mark.parametrize("name", ["emps", "scara"])
def test_no_loss_finds_nothing(q, name):
    assert shares(q[name]).max() == 0
    assert position_steps(q[name])[0][-1] > 0.5 * len(q[name])


@pytest.mark.parametrize(
    ("what", "step"),
    [("12 bit over the range", None), ("slow motion", 1e-5), ("Stribeck 50 %", 1e-5)],
)
def test_coarse_slow_motion_finds_none(what, step):
    """Counts of 10 µm beside those of the kind."""
    setup = KINDS[what].change(short("emps", 3), np.random.default_rng(3))
    setup = setup if step is None else setup.in_cell(encoder_step=step, encoder_noise=0.0)
    assert shares(setup.recording(7).q).max() == 0


def test_abrupt_stops_are_no_missing_rows():
    """Of two steps at a stop one is twice the median of its neighbours,
    and the other none of it.
    """
    speed = np.repeat([1.0, 0.0, -1.0, 0.0] * 50, 40) * 1e-3
    q = np.cumsum(speed)[:, None] + 1e-6 * np.random.default_rng(0).standard_normal((len(speed), 1))
    assert shares(q).max() == 0


@pytest.mark.parametrize("name", ["emps", "scara", "tx40"])
def test_shipped_sessions_find_nothing_at_any_rate(name):
    q = load_signals(REPLAY / name / "session.mcap").q
    assert max(shares(q[::every]).max() for every in (1, 2, 5, 10)) == 0


def line_of(fit):
    return next((line for line in fit.trust.lines if line.test == "rows"), None)


def test_real_axis_complete_real_arm_slow_encoder(emps, tx40):
    axis, arm = signals_of(emps), signals_of(tx40)
    assert line_of(ls_of(emps)) is None
    note = line_of(ls_of(tx40))
    assert (note.level, note.value) == ("ok", None)
    assert "encoder of joint joint_3" in note.text
    # coarse and abrupt motion at a low rate
    assert max(shares(axis.q[::50]).max(), shares(arm.q[2::5]).max()) == 0


def test_lost_array_rows_give_caution():
    signals = short("scara", 1).recording(1)
    lossy = with_lost_rows(signals, drawn(len(signals.q), 1.0))
    arrays = signals_from_arrays(
        lossy.q, lossy.effort, lossy.sample_rate_hz, robot_named("scara"), lossy.q_ref
    )
    fit = identify_ls(arrays, Overrides())
    line = line_of(fit)
    assert (line.level, line.value) == ("caution", pytest.approx(1.0, abs=0.1))
    assert fit.trust.verdict != "trust"
