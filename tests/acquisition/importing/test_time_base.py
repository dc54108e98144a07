"""Times of rows: what is interpolated, what is refused, what is told,
against times made by hand.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import robot_named
from jittered_time import MAP
from scipy.interpolate import CubicSpline

from acquisition.errors import BadInputError, Location
from acquisition.importing import (
    import_tables,
    interpolate,
    rate_warnings,
    resample,
    rows_in_time,
    stamps_warning,
    ticks_from_velocity,
    time_report,
)
from acquisition.recording import read_recording

RNG = np.random.default_rng(5)
UNEVEN = np.cumsum(RNG.choice([0.008, 0.010, 0.013], 400))


def motion(t: np.ndarray) -> np.ndarray:
    return np.stack([0.5 * np.sin(3 * t), 0.2 * np.cos(5 * t)], axis=1)


def on_grid(
    t: np.ndarray,
    rate_hz: float | None = 100.0,
    largest_gap_periods: float = 3.0,
    **parts: np.ndarray,
):
    parts, place = parts or {"q": motion(t)}, Location("log")
    return resample(t, parts, rate_hz=rate_hz, largest_gap_periods=largest_gap_periods, place=place)


def test_values_are_interpolated_at_their_times():
    """A cubic between rows is off by 5/384 h⁴ of the fourth derivative at
    most, 40.5 and 125 here.
    """
    found = on_grid(UNEVEN)
    t = found.start_s + np.arange(len(found.parts["q"])) / 100
    assert found.start_s == UNEVEN[0]
    assert t[-1] <= UNEVEN[-1] < t[-1] + 0.01
    off = np.abs(found.parts["q"] - motion(t))[20:-20].max(axis=0)
    assert (off < 5 / 384 * 0.013**4 * np.array([40.5, 125])).all()
    assert off.max() > 1e-10  # of a line through the rows it is a thousand times as much


@pytest.mark.parametrize("rate_hz", [1.0, 93.0, 1000.0])
@pytest.mark.parametrize("block", [61, 100, 399, 1000])
def test_block_splines_match_full_spline(monkeypatch, rate_hz, block):
    """Of scipy, and of noise, on which a row acts furthest; before and after the rows too."""
    monkeypatch.setattr("acquisition.importing.time_base.BLOCK_ROWS", block)
    noise, at_s = RNG.normal(size=(400, 2)), np.arange(-0.01, UNEVEN[-1] + 0.01, 1 / rate_hz)
    whole = CubicSpline(UNEVEN, noise)(at_s)
    np.testing.assert_allclose(interpolate(UNEVEN, noise, at_s), whole, atol=1e-13)


def test_timing_report_by_hand():
    """Steps of 10, 10, 8, 12, 10, 30 and 10 ms: two rows missing in one gap, a deviation of
    1.15 ms of the others.
    """
    t = 5 + np.cumsum([0, 10, 10, 8, 12, 10, 30, 10]) * 1e-3
    report = time_report(t, doubled=2)
    assert (report.rows, report.doubled, report.gaps, report.missing) == (8, 2, 1, 2)
    assert (report.shortest_s, report.period_s, report.longest_s) == pytest.approx(
        (0.008, 0.010, 0.030)
    )
    assert report.jitter_s == pytest.approx(np.std([10, 10, 8, 12, 10, 10]) * 1e-3)
    told = (
        "timestamps of 8 rows: steps 8 to 30 ms, median 10 ms, jitter sd 1.155 ms, 1 gaps, 2 rows "
        "missing, 2 duplicate rows"
    )
    assert report.text == f"{told} left out"
    assert time_report(t[:5]).text.endswith("no gaps, no duplicate rows")


def test_contradicting_rows_are_refused():
    twice = np.insert(UNEVEN, 7, UNEVEN[7])
    q = motion(twice)
    q[8, 1] += 1e-6
    for t, parts, told in (
        (
            twice,
            {"position": q},
            "log: row 9: position differs from the row before at the same time, ",
        ),
        (
            np.concatenate([UNEVEN[:5], UNEVEN[2:]]),
            {},
            r"row 6: time runs backwards: 0\.0\d+ s follows 0\.0\d+ s",
        ),
        (UNEVEN[[0, 0, 1, 2]], {}, "only 3 rows have different times: expected at least 4"),
    ):
        with pytest.raises(BadInputError, match=told):
            on_grid(t, **parts)


def test_gaps_over_given_limit_are_refused():
    """Of steps of 10 ms, two rows missing are a gap of three periods."""
    two, three = (np.delete(np.arange(400) * 0.01, range(50, 50 + missing)) for missing in (2, 3))
    assert on_grid(two).report.missing == 2
    with pytest.raises(BadInputError) as caught:
        on_grid(three)
    assert (
        "log: time: a gap of 0.04 s after 0.49 s is 4.0 periods long, more than 3. Import"
        in str(caught.value)
    )
    assert on_grid(three, None, 4).rate_hz == 100.0


def test_late_timestamps_are_detected():
    even = np.arange(600) / 100
    stamps = even + 0.0015 * RNG.standard_normal(600)
    noise = 1e-6 * RNG.standard_normal((600, 2))
    told = stamps_warning(stamps, motion(even) + noise, "go")
    assert "but the motion does not" in told
    by_row, by_stamp = (float(part.split(" ms")[0]) for part in told.split(" within ")[1:])
    assert by_row < 0.1
    assert by_stamp == pytest.approx(1.5, rel=0.2)
    kept = np.delete(np.arange(600), [100, 300, 301])
    for t, q, is_told in (
        (stamps, motion(stamps) + noise, False),
        (even, motion(even) + noise, False),
        # Noise of the position, 0.5 ms of motion here, leaves it to be seen; more of it hides it.
        (stamps, motion(even) + 5e-4 * RNG.standard_normal((600, 2)), True),
        (stamps, motion(even) + 0.02 * RNG.standard_normal((600, 2)), False),
        # numbers of rows are counted on where some are missing
        (stamps[kept], (motion(even) + noise)[kept], True),
    ):
        assert (stamps_warning(t, q, "go") is not None) == is_told


def test_timestamps_off_by_tick_are_found():
    """Of rows at their stamps, one in fifteen is off by 1 ms; those of a joint
    that stands tell nothing.
    """
    stamps, wrong = UNEVEN.copy(), np.arange(5, 395, 15)
    stamps[wrong] += 0.001 * np.where(np.arange(len(wrong)) % 2, 1, -1)
    q = motion(UNEVEN) + 1e-5 * RNG.standard_normal((400, 2))
    left_out = np.flatnonzero(~rows_in_time(stamps, q))
    assert set(left_out) <= set(wrong)
    assert len(left_out) >= len(wrong) - 4  # where both joints nearly stand, nothing shows
    found = on_grid(stamps, position=q)
    assert found.report.off == len(left_out)
    t = stamps[0] + np.arange(len(found.parts["position"])) / 100
    off = np.abs(found.parts["position"] - motion(t))[10:-10].max()
    assert off < 3e-4
    assert np.abs(on_grid(stamps, q=q).parts["q"] - motion(t))[10:-10].max() > 3 * off
    for right, positions in (
        # less than a twentieth of a period, however plain
        (UNEVEN + 0.3 * (stamps - UNEVEN), motion(UNEVEN)),
        (UNEVEN, motion(UNEVEN)),
        (stamps, np.zeros((400, 2))),
        (stamps[:10], q[:10]),
    ):
        assert rows_in_time(right, positions).all()


def settling(t: np.ndarray) -> np.ndarray:
    after = np.maximum(t % 20 - np.array([[2.0], [12.0]]), 0).T
    q = 0.3 * (1 - np.exp(-3 * after) * np.cos(20 * after))
    return np.round(q + 3e-5 * np.random.default_rng(2).standard_normal(q.shape), 4)


def test_rows_of_settling_arm_are_kept():
    """Among even stamps all of them, also stamps in microseconds; among
    uneven stamps all but 0.5 %.
    """
    even = np.arange(10_000) * 0.01
    assert rows_in_time(even, settling(even)).all()
    assert rows_in_time(np.round(even, 6), settling(even)).all()
    uneven = np.cumsum(np.random.default_rng(1).choice([0.008, 0.010, 0.013], 10_000))
    assert (~rows_in_time(uneven, settling(uneven))).mean() < 0.005


def test_unsuited_grid_warns():
    def doubts(rate_hz: float, **found: int) -> list[str]:
        return rate_warnings(replace(on_grid(UNEVEN, rate_hz).report, **found))

    assert doubts(100.0) == doubts(200.0) == doubts(100.0, off=8) == []
    assert doubts(80.0)[0].startswith("resample_hz = 80 is below the rate of the rows, 100 Hz")
    assert doubts(260.0)[0].startswith("resample_hz = 260 is 2.6 times the rate of the rows")
    assert doubts(100.0, off=10)[0].startswith("2.5 % of the rows are left out")
    assert rate_warnings(time_report(UNEVEN)) == []
    for rate_hz in (1e-3, 1e9):
        with pytest.raises(
            BadInputError,
            match=r"resample_hz = .*: the rows come at 100 Hz and last",
        ):
            doubts(rate_hz)


ROBOT = robot_named("scara")
TICKS_MAP, K = MAP.replace('column = "t"', 'ticks = "k"\ntick_s = 0.001'), np.arange(400)


def table(folder: Path, columns: dict[str, np.ndarray]) -> Path:
    path = folder / "log.csv"
    np.savetxt(
        path,
        np.stack([*columns.values()], axis=1),
        delimiter=",",
        header=",".join(columns),
        comments="",
    )
    return path


def named(q: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(("q1", "q2", "r1", "r2", "e1", "e2"), np.hstack([q, q, q]).T, strict=True))


def columns(times_s: np.ndarray, **more: np.ndarray) -> dict[str, np.ndarray]:
    return more | named(motion(times_s))


def run(folder: Path, path: Path, text: str):
    (folder / "map.toml").write_text(text)
    return import_tables([path], ROBOT, folder / "map.toml", folder / "out.mcap")


def test_counter_gives_time(tmp_path):
    """Ticks of a millisecond, counted from 5000, four rows missing; stamps of a PC beside
    them are off by 1.2 ms.
    """
    ticks = 5000 + 10 * np.delete(np.arange(400), [40, 41, 200, 300])
    t = ticks * 1e-3
    path = table(tmp_path, columns(t, k=ticks, t=77.0 + t + 0.0012 * RNG.standard_normal(len(t))))
    found = run(tmp_path, path, TICKS_MAP)
    recording = read_recording(found.out)
    assert recording.samples["stamp_ns"].tolist() == [
        5_000_000_000 + 10_000_000 * k for k in range(400)
    ]
    assert recording.samples["position"] == pytest.approx(
        motion(5 + np.arange(400) / 100), abs=1e-5
    )
    assert found.times.startswith("ticks of 396 rows: steps 10 to 30 ms, median 10 ms, jitter ")
    assert found.times.endswith("3 gaps, 4 rows missing, no duplicate rows, interpolated to 100 Hz")
    assert found.warnings == ()
    assert recording.metadata["times"] == found.times
    both = run(tmp_path, path, TICKS_MAP.replace("tick_s", 'column = "t"\ntick_s'))
    assert float(both.times.split("timestamps sd ")[1].split(" ms")[0]) == pytest.approx(
        1.2, rel=0.15
    )
    # By the stamps the same rows are rougher, and that is told; the fit repeats it.
    by_stamps = run(tmp_path, path, MAP)
    (warning,) = by_stamps.warnings
    assert warning.startswith("timestamps jitter by ")
    assert [event.text for event in read_recording(by_stamps.out).events] == [warning]


def test_ticks_are_counted_by_speed(tmp_path):
    """Ticks of 1 ms, 2 % of them missing and 2 % twice; stamps are up to 8 ms late, and the
    arm stands for a second.
    """
    rng = np.random.default_rng(0)
    ticks = np.repeat(np.arange(8000), rng.choice([0, 1, 2], 8000, p=[0.02, 0.96, 0.02]))
    t = np.maximum(ticks * 1e-3 - np.clip(ticks * 1e-3 - 4, 0, 1), 0)  # of the motion
    stand = (ticks > 4000) & (ticks < 5000)
    v = np.where(stand[:, None], 0.0, np.stack([1.5 * np.cos(3 * t), -np.sin(5 * t)], axis=1))
    q = motion(t) + 1e-5 * rng.standard_normal((len(t), 2))
    stamps = np.maximum.accumulate(
        70 + 1e-3 * ticks + np.minimum(rng.exponential(1.5e-3, len(t)), 8e-3)
    )
    found = ticks_from_velocity(stamps, q, v, 1e-3)
    moving = ~(stand[1:] | stand[:-1])
    assert (np.diff(found) == np.diff(ticks))[moving].mean() > 0.99
    off = found - ticks
    assert np.abs(off - np.median(off))[~stand].max() <= 2
    path = table(tmp_path, {"t": stamps, "v1": v[:, 0], "v2": v[:, 1]} | named(q))
    by_speed = MAP.replace('column = "t"', 'column = "t"\nticks = "from velocity"\ntick_s = 0.001')
    by_speed = by_speed.replace("= 100", "= 1000")
    imported = run(
        tmp_path, path, f'{by_speed}[velocity]\ncolumns = ["v1", "v2"]\nunit = "rad/s"\n'
    )
    assert imported.times.startswith("ticks of ")
    with pytest.raises(BadInputError) as refused:
        run(tmp_path, path, by_speed)
    assert (refused.value.key, refused.value.value) == ("time.ticks", "from velocity")


@pytest.mark.parametrize(
    ("old", "new", "column", "place", "key", "value"),
    [
        ("tick_s = 0.001", "", K, "map.toml", "time.tick_s", None),
        ('ticks = "k"', "", K, "map.toml", "time.ticks", None),
        ("tick_s", "tick_s", np.where(K == 3, 3.5, K), "log.csv: row 4", "k", 3.5),
        ("tick_s", 'column = "k"\ntick_s', 10 * K, "map.toml", "time.tick_s", 0.001),
        ("[time]", "sample_rate_hz = 50\n[time]", K, "map.toml", "sample_rate_hz", 50.0),
        ("[position]", "largest_gap_periods = 1\n[position]", K, "map.toml",
         "time.largest_gap_periods", 1),
        # A counter that runs through its end, in 16 bits.
        ("tick_s", "tick_s", (65_300 + 10 * K) % 65_536, "log.csv: k", "row 25", None),
    ],
)  # fmt: skip
def test_invalid_tick_times(tmp_path, old, new, column, place, key, value):
    with pytest.raises(BadInputError) as caught:
        run(tmp_path, table(tmp_path, columns(UNEVEN, k=column)), TICKS_MAP.replace(old, new))
    error = caught.value
    assert (error.place, error.key, error.value) == (f"{tmp_path}/{place}", key, value)
    assert not (tmp_path / "out.mcap").exists()
