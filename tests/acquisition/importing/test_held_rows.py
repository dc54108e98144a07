"""Logs that are faster than their robot: only new rows are kept, at the rate and the instants of
their source; coarse encoders and robots that stand are left alone.
"""

from pathlib import Path

import numpy as np
import pytest

from acquisition.commands import main
from acquisition.errors import Location
from acquisition.importing import grid_of_new_rows
from acquisition.recording import read_recording

SECONDS = 12.0
JOINTS = "".join(
    f'[[joint]]\nname = "j{k}"\ntype = "revolute"\n'
    "dh = { alpha_deg = 0, d_m = 0.1, theta_deg = 0, r_m = 0 }\n"
    f'[[motor]]\nname = "m{k}"\neffort_unit = "N m"\n'
    for k in range(3)
)


def motion(t_s):
    """Positions and efforts (N, 3), smooth but for friction."""
    w = 2 * np.pi * np.array([0.31, 0.47, 0.59])
    q, dq = np.sin(np.outer(t_s, w)), w * np.cos(np.outer(t_s, w))
    return {"position": q, "effort": 20 * np.cos(q) + 5 * np.tanh(dq / 0.05) + 2 * dq}


def logged(source_s, log_hz, new=("position", "effort")):
    """Rows of a log in which the quantities `new` are the source's last ones, others of the row."""
    t_s = np.arange(round(SECONDS * log_hz)) / log_hz
    last = np.searchsorted(source_s, t_s + 1e-9) - 1
    rows, own = motion(source_s), motion(t_s)
    return t_s, {name: rows[name][last] if name in new else own[name] for name in rows}


def even(rate_hz):
    return np.arange(round(SECONDS * rate_hz)) / rate_hz


MAP = """{time}
[position]
columns = [1, 2, 3]
unit = "rad"
side = "joint"
[effort]
columns = [4, 5, 6]
unit = "N m"
side = "joint"
"""
TIMES = {
    "a column of times": '[time]\ncolumn = 7\nunit = "s"',
    "times and a rate above the source's": '[time]\ncolumn = 7\nunit = "s"\nresample_hz = 500',
    "a rate": "sample_rate_hz = 500",
}


@pytest.mark.parametrize("times", TIMES)
def test_table_is_imported_at_source_rate(tmp_path, capsys, times):
    t_s, parts = logged(even(125), 500)
    np.savetxt(tmp_path / "log.csv", np.c_[parts["position"], parts["effort"], t_s], delimiter=",")
    (tmp_path / "map.toml").write_text(MAP.format(time=TIMES[times]))
    (tmp_path / "robot.toml").write_text(f'name = "arm"\n[controller]\n{JOINTS}')
    names = {name: str(tmp_path / name) for name in ("log.csv", "map.toml", "robot.toml", "a.mcap")}
    log, table_map, robot, out = names.values()
    assert main(["import", log, "--map", table_map, "--robot", robot, "-o", out]) == 0
    recording = read_recording(Path(out))
    assert recording.sample_rate_hz == 125
    np.testing.assert_allclose(recording.samples["position"], parts["position"][::4], atol=1e-8)
    assert "new ones come at 125 Hz" in capsys.readouterr().out


RATES = [(125, 200), (125, 500), (100, 500), (167, 500), (250, 1000), (400, 500)]


@pytest.mark.parametrize(("source_hz", "log_hz"), RATES)
def test_new_rows_keep_source_times(source_hz, log_hz):
    """Up to a period of the log late, which is the same for all rows."""
    found = grid_of_new_rows(*logged(even(source_hz), log_hz), Location("log"))
    assert found.rate_hz == source_hz
    assert len(found.parts["position"]) == pytest.approx(SECONDS * source_hz, abs=1)
    t_s = np.arange(len(found.parts["position"])) / source_hz
    for name, x in motion(t_s).items():
        np.testing.assert_allclose(found.parts[name], x, atol=1e-9)
    (told,) = found.warnings
    assert f"repeats each position {log_hz / source_hz:.2g} times" in told
    assert f"new ones come at {source_hz} Hz" in told


def test_jittering_source_becomes_even():
    rng = np.random.default_rng(1)
    t_s, parts = logged(even(250) + rng.uniform(0, 1.5e-3, round(250 * SECONDS)), 1000)
    found = grid_of_new_rows(t_s, parts, Location("log"))
    assert found.rate_hz == 250
    assert found.report.gaps == 0


def test_lost_source_rows_are_gaps_in_grid():
    """Two rows, within whose time values are interpolated; ten, a gap."""
    there = np.delete(even(125), [400, 800, *range(1000, 1010)])
    found = grid_of_new_rows(*logged(there, 500), Location("log"))
    assert (found.rate_hz, found.report.missing) == (125, 12)
    assert np.flatnonzero(found.absent).tolist() == list(range(1000, 1010))
    q = motion(np.arange(len(found.absent)) / 125)["position"]
    np.testing.assert_allclose(found.parts["position"][~found.absent], q[~found.absent], atol=1e-5)


@pytest.mark.parametrize("share", [0.02, 0.2])
@pytest.mark.parametrize(("source_hz", "log_hz"), RATES[:4])
def test_many_lost_rows_do_not_distort_time(source_hz, log_hz, share):
    """Values next to missing rows are interpolated, others at their instants."""
    there = np.random.default_rng(2).random(round(SECONDS * source_hz)) > share
    found = grid_of_new_rows(*logged(even(source_hz)[there], log_hz), Location("log"))
    assert found.rate_hz == source_hz
    first = int(np.argmax(there))
    q = motion((first + np.arange(len(found.parts["position"]))) / source_hz)["position"]
    measured = ~found.absent if found.absent is not None else slice(None)
    assert np.abs(found.parts["position"] - q)[measured].max() < 1e-4
    exact = there[first:][: len(q)]
    np.testing.assert_allclose(found.parts["position"][exact], q[exact], atol=1e-9)


@pytest.mark.parametrize(("source_hz", "log_hz"), RATES[:5])
def test_pauses_do_not_distort_time(source_hz, log_hz):
    """A robot that stands for 4 s before its motion and for 3 s within it: no row is new then."""
    source_s, t_s = even(source_hz), even(log_hz)
    moved_s = np.clip(source_s - 4, 0, 3) + np.clip(source_s - 10, 0, None)
    last = np.searchsorted(source_s, t_s + 1e-9) - 1
    rows = {name: x[last] for name, x in motion(moved_s).items()}
    found = grid_of_new_rows(t_s, rows, Location("log"))
    assert found.rate_hz == source_hz
    first = round(found.start_s * source_hz)
    q = motion(moved_s)["position"][first:][: len(found.absent)]
    np.testing.assert_allclose(found.parts["position"][~found.absent], q[~found.absent], atol=1e-9)
    assert found.absent.sum() > 5 * source_hz


def test_randomly_repeated_rows_keep_times():
    t_s, parts = logged(even(500), 500)
    late = np.random.default_rng(3).random(len(t_s)) < 0.2
    last = np.maximum.accumulate(np.where(late, 0, np.arange(len(t_s))))
    found = grid_of_new_rows(t_s, {name: x[last] for name, x in parts.items()}, Location("log"))
    assert found.rate_hz == 500
    off = found.parts["position"] - parts["position"][: len(found.parts["position"])]
    assert np.abs(off).max() < 1e-6


def test_efforts_new_in_each_row_keep_times():
    t_s, parts = logged(even(125), 500, new=("position",))
    found = grid_of_new_rows(t_s, parts, Location("log"))
    t_s = np.arange(len(found.parts["effort"])) / 125
    late_s = 0.5 * (found.start_s - 0.0)
    np.testing.assert_allclose(found.parts["effort"], motion(t_s + 2 * late_s)["effort"], atol=2e-3)


def test_lower_given_rate_is_used():
    rows = logged(even(125), 500)
    rates = [grid_of_new_rows(*rows, Location("log"), hz).rate_hz for hz in (500.0, 50.0)]
    assert rates == [125, 50]


@pytest.mark.parametrize(
    "change",
    [
        lambda q: q,
        lambda q: np.round(q, 3),
        lambda q: np.round(q / 0.01) * 0.01,
        lambda q: q[np.minimum(np.arange(len(q)), 3000)],
        lambda q: np.zeros_like(q),
        lambda q: np.where(np.arange(len(q))[:, None] % 50 == 0, np.roll(q, 1, axis=0), q),
    ],
)
def test_other_rows_are_unchanged(change):
    """As they are, coarse, standing still for half of the time, never moving, a row in 50 late."""
    t_s = even(500)
    parts = motion(t_s)
    parts["position"] = change(parts["position"])
    assert grid_of_new_rows(t_s, parts, Location("log")) is None
