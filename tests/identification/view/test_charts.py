"""The charts of the HTML report as data, their axes, and how they are drawn."""

import math
import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from pictured_fits import FS, fitted, made_up, values

from identification.report import TrustResult
from identification.results import fit_file
from identification.study import Run, RunFit
from identification.view import recording_panels
from identification.view.charts import STUDY_ROWS, deviation_charts, study_chart, trust_charts
from identification.view.html_page import HEAD, PITCH, draw_graph, draw_rows
from identification.view.panels import (
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Column,
    Mark,
    Rows,
    decades,
    linear,
    logarithmic,
)
from identification.view.recording_panels import spectrum_charts


def found(column, **given):
    return [
        m for m in column.marks if all(getattr(m, name) == value for name, value in given.items())
    ]


AXES = {
    "linear": (linear(-1.0, 9.0, 5), {0.0: "0", 2.0: "2", 4.0: "4", 6.0: "6", 8.0: "8"}, 4.0, 0.5),
    "small": (
        linear(0.0, 0.03, 3),
        {0.0: "0.00", 0.01: "0.01", 0.02: "0.02", 0.03: "0.03"},
        0.015,
        0.5,
    ),
    "logarithmic": (logarithmic(0.5, 500.0, 6), {1.0: "1", 10.0: "10", 100.0: "100"}, 5.0, 1 / 3),
    "decades": (
        decades([3e-6, 0.2], 3),
        {1e-6: "1e-6", 1e-4: "1e-4", 1e-2: "0.01", 1.0: "1"},
        1e-3,
        0.5,
    ),
    "a point": (linear(2.0, 2.0, 3), {2.0: "2"}, 2.0, 0.0),
    "beyond": (linear(0.0, 1.0, 1), {0.0: "0", 1.0: "1"}, 7.0, 1.0),
    "zero": (
        logarithmic(0.01, 100.0, 4),
        {0.01: "0.01", 0.1: "0.1", 1.0: "1", 10.0: "10", 100.0: "100"},
        0.0,
        0.0,
    ),
}


@pytest.mark.parametrize("case", AXES)
def test_axis_has_round_ticks(case):
    axis, ticks, value, share = AXES[case]
    assert {round(tick, 12): text for tick, text in axis.ticks.items()} == ticks
    assert axis.place(value, 100.0, 200.0) == pytest.approx(100.0 + 100.0 * share)


def test_parameter_rows_have_intervals_differences():
    own = values("IV", M1=(2.0, 0.3), M2=(-1.0, 0.1), M3=(0.0, 0.1))
    own.parameters["M2"] = msgspec.structs.replace(own.parameters["M2"], essential=False)
    ls, true = (
        values("LS", M1=(2.4, 0.3), M2=(-9.0, 0.1)),
        values("true", M1=(2.1, 0.0), M2=(-1.0, 0.0)),
    )
    (chart,) = deviation_charts(own, [ls, true])
    assert chart.names == [("M1", ORANGE), ("M2", GREY), ("M3", ORANGE)]
    assert {("× LS", PURPLE), ("| true", GREEN)} <= set(chart.legend)
    interval, far = chart.columns
    ends = [x for m in interval.marks for x in (m.value - m.half, m.value + m.half)]
    assert ends == pytest.approx([100 * 1.412 / 2.588, 100, -100, -100 * 0.804 / 1.196, -100, 100])
    assert interval.lines == (0.0,)
    own_marks = [m for m in far.marks if m.shape in ("dot", "ring")]
    assert [(m.row, m.value, m.half, m.shape) for m in own_marks] == [
        (0, 0.0, 1.0, "dot"), (1, 0.0, 1.0, "ring"), (2, 0.0, 1.0, "dot"),
    ]  # fmt: skip
    assert [(m.value, m.half) for m in found(far, shape="tick")] == [
        (pytest.approx(0.1 / 0.588), 0.0),
        (0.0, 0.0),
    ]
    crosses = [(math.floor(m.row), m.value, m.half, m.color) for m in found(far, shape="cross")]
    assert crosses == [
        (0, pytest.approx(0.4 / 0.588), pytest.approx(1.0), PURPLE),
        (
            1,
            pytest.approx(-8.0 / 0.196),
            pytest.approx(1.0),
            VERMILLION,
        ),  # more than 3 standard errors
    ]
    assert far.lines == (-1.0, 0.0, 1.0)
    exact = deviation_charts(true, [own])[0].columns[1]
    assert [m.value for m in found(exact, shape="cross")] == pytest.approx([-0.1 / 0.588, 0.0]), (
        "in those of the other"
    )
    assert len(deviation_charts(own, [])[0].columns) == 1


def test_interval_with_zero_crosses_line_at_zero():
    """Of values between half and twice their half-widths, on both sides of zero."""
    rng = np.random.default_rng(7)
    half = rng.uniform(1e-3, 1e3, 12)
    value = half * rng.uniform(0.5, 2.0, 12) * np.tile([1, -1], 6)
    own = values("IV", **{f"M{k}": (value[k], half[k] / 1.96) for k in range(12)})
    (chart,) = deviation_charts(own, [])
    drawn = draw_rows(chart)
    head = {t: float(x) for x, t in re.findall(r'x="([\d.]+)" y="31">([-\d]+)<', drawn)}
    (zero,) = map(float, re.findall(r'stroke-width="1.5" d="M([\d.]+) ', drawn)[:1])
    assert zero == head["0"] == pytest.approx(0.5 * (head["-100"] + head["100"]), abs=0.1)
    found = re.findall(r'l orange" stroke-width="2.2" d="M([\d.]+) ([\d.]+)H([\d.]+)"', drawn)
    low, y, high = np.array(found, dtype=float).T
    np.testing.assert_allclose(y, HEAD + PITCH * (np.arange(12) + 0.5), atol=0.06)
    assert ((low < zero) & (zero < high)).tolist() == (abs(value) < half).tolist()
    assert 3 < (abs(value) < half).sum() < 9
    reach = (head["100"] - zero) / (abs(value) + half)
    np.testing.assert_allclose(low, zero + reach * (value - half), atol=0.11)
    np.testing.assert_allclose(high, zero + reach * (value + half), atol=0.11)


def test_figures_of_tests_have_intervals():
    figures = (
        ("shoulder", 1.2, 0.2, -0.5),
        ("elbow", -0.5, 0.0, 0.0),
    )
    lag = TrustResult(
        test="delay", level="caution", text="late", value=1.2, unit="samples", figures=figures
    )
    made = TrustResult(test="outliers", level="ok", text="no outlier", value=-5.0)
    (of_lag,) = trust_charts([lag, made])
    assert of_lag.legend == (("● value with 95 % interval", ORANGE), ("| expected", GREEN))
    (of_blocks,) = trust_charts([msgspec.structs.replace(lag, figures=figures[1:])])
    assert of_blocks.legend[0] == ("● value", ORANGE), "without intervals none is named"
    assert of_lag.title == "delay: caution"
    assert of_lag.names == [("shoulder", LIGHT), ("elbow", LIGHT)]
    (column,) = of_lag.columns
    assert column.head == "samples"
    assert [(m.row, m.value) for m in found(column, shape="tick", color=GREEN)] == [
        (0, -0.5),
        (1, 0.0),
    ]
    assert [(m.row, m.value, m.half) for m in found(column, shape="dot", color=ORANGE)] == [
        (0, 1.2, 0.2),
        (1, -0.5, 0.0),
    ]
    assert column.axis.low < -0.5
    assert column.axis.high > 1.4


def a_run(number, ls, iv, status="converged"):
    def fit(error):
        ends = {"low": np.zeros(2), "high": np.ones(2)}
        known = {"verdict": "trust", "essential": np.ones(2, dtype=bool), "positive": True}
        return RunFit(beta=np.ones(2), error=error, **ends, **known)

    return Run(number=number, status=status, ls=fit(ls), iv=None if iv is None else fit(iv))


def test_study_has_errors_and_medians_by_method():
    runs = [a_run(k, ls, iv) for k, (ls, iv) in enumerate([(0.1, 0.01), (0.2, 0.03), (0.3, 0.02)])]
    runs += [a_run(3, 0.9, None, "diverged"), a_run(4, 0.2, 0.9, "max_iterations")]
    chart = study_chart(runs)
    assert [name for name, _ in chart.names if name] == ["LS: median 20", "IV: median 2"]
    (column,) = chart.columns
    marks = {
        "tick": [20.0] * STUDY_ROWS + [2.0] * STUDY_ROWS,
        "cross": [10.0, 20.0, 30.0, 90.0, 20.0],
        "dot": [1.0, 3.0, 2.0],
        "ring": [90.0],
    }
    assert {kind: [m.value for m in found(column, shape=kind)] for kind in marks} == marks
    assert all(-0.5 < m.row < STUDY_ROWS - 0.5 for m in found(column, shape="cross"))
    assert all(STUDY_ROWS - 0.5 < m.row < 2 * STUDY_ROWS - 0.5 for m in found(column, shape="dot"))
    assert (column.axis.low, column.axis.high) == (1.0, 100.0)
    none = [replace(run, ls=None, iv=None) for run in runs]
    assert [name for name, _ in study_chart(none).names if name] == ["LS", "IV"]


def test_spectra_show_sine_and_fit_cutoffs():
    signals = made_up(types=("revolute",))
    settings = fitted(signals).settings
    sine = replace(signals, q=1e-3 * np.sin(2 * np.pi * 80.0 * signals.t_s)[:, None])
    position, effort = spectrum_charts(sine, settings)
    (curve,) = position.curves
    assert curve.line[0][curve.line[1].argmax()] == pytest.approx(80.0, rel=0.06), (
        "a band of 40 in a decade"
    )
    assert set(position.marks.values()) == {
        "bandwidth 10 Hz",
        f"low-pass {settings.cutoff_hz:g} Hz",
    }
    assert position.marks[settings.cutoff_hz].startswith("low-pass")
    assert f"decimation {0.4 * FS / settings.decimation:g} Hz" in effort.marks.values()
    assert position.title == "position [rad/√Hz] over frequency [Hz]"
    short = replace(signals, t_s=signals.t_s[:10], q=signals.q[:10], effort=signals.effort[:10])
    assert spectrum_charts(short, None) == []
    drawn = draw_graph(position)
    ticks = {
        text: float(x) for x, text in re.findall(r'middle" x="([\d.]+)" y="194">([^<]+)<', drawn)
    }
    marks = {
        text: float(x)
        for x, text in re.findall(r'end" x="([\d.]+)" y="[\d.]+">(\w[^<]+ Hz)<', drawn)
    }
    per_decade = ticks["100"] - ticks["10"]
    assert marks["bandwidth 10 Hz"] + 4 == pytest.approx(ticks["10"], abs=0.2)
    at = ticks["10"] + per_decade * math.log10(settings.cutoff_hz / 10.0)
    assert marks[f"low-pass {settings.cutoff_hz:g} Hz"] + 4 == pytest.approx(at, abs=0.2)
    assert "bandwidth" not in draw_graph(replace(position, marks={1e6: "bandwidth 1e6 Hz"})), (
        "beyond the axis"
    )


def test_resting_joint_has_chart_without_rows(monkeypatch):
    rows = recording_panels.rigid_torque_at_rows
    monkeypatch.setattr(
        recording_panels,
        "rigid_torque_at_rows",
        # of a recording that is too long to be held
        lambda of, beta: tuple(x * [1.0, 0.0] for x in rows(of.without_samples, beta)),
    )
    fit = fitted(made_up())
    _, still = recording_panels.friction_charts(fit_file(fit), fit.recordings)
    assert sum(len(dots) for dots, _ in still.dots) == 0
    assert "nan" not in draw_graph(still)


def test_rows_drawn_at_their_axis_position():
    marks = [
        Mark(row=0, value=0.5, half=0.25, color=ORANGE),
        Mark(row=1, value=0.5, color=GREY, shape="ring"),
        Mark(row=1.5, value=0.75, color=PURPLE, shape="cross"),
        Mark(row=2, value=-0.5, color=GREEN, shape="bar"),
        Mark(row=2, value=0.25, color=SKY, shape="tick"),
    ]
    column = Column(head="<head>", axis=linear(-1.0, 1.0, 4), marks=marks, lines=(0.25,))
    rows = Rows(
        path=("x",),
        title="a & b",
        names=[("one", LIGHT), ("two", LIGHT), ("three", LIGHT)],
        columns=[column],
    )
    text = draw_rows(rows)
    assert 'aria-label="a &amp; b"' in text
    assert "&lt;head&gt;" in text
    ticks = {
        t: float(x) for x, t in re.findall(rf'middle" x="([\d.]+)" y="{HEAD - 5:g}">([^<]+)<', text)
    }
    zero, one = ticks["0.0"], ticks["1.0"]

    def path(kind):
        return [
            tuple(map(float, re.findall(r"-?[\d.]+", d)[:3]))
            for d in re.findall(rf'{kind}"[^>]* d="([^"]*)"', text)
        ]

    def at(value, row):
        return pytest.approx((zero + value * (one - zero), HEAD + PITCH * (row + 0.5)), abs=0.11)

    (interval,), (dot,) = path("l orange"), path("f orange")
    assert interval[:2] == at(0.25, 0)
    assert interval[2] == pytest.approx(zero + 0.75 * (one - zero), abs=0.11)
    assert dot[:2] == at(0.5, 0)
    assert path("l grey")[0][:2] == at(0.5, 1)
    assert path("l purple")[0][:2] == at(0.75, 1.5)
    (bar,) = path("l green")
    assert (bar[:2], bar[2]) == (at(0.0, 2), pytest.approx(-0.5 * (one - zero), abs=0.11))
    assert path("l sky")[0][:2] == at(0.25, 2)
