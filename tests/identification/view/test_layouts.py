"""What is seen first of a Rerun file: shares of the screen, ticks, the robot, intervals."""

from dataclasses import replace

import numpy as np
import pytest
from blueprints import opening_screen
from conftest import REPLAY
from fits_of_records import ls_of, picture_of, signals_of
from pictured_fits import Written, made_up
from random_arms import random_arm
from rerun.chunk import RrdReader

from identification.model import InverseModel
from identification.regression import Overrides
from identification.report import Document
from identification.view import draw_recording, write_rrd
from identification.view.panels import (
    GREEN,
    ORANGE,
    Axis,
    Column,
    Curve,
    Mark,
    Page,
    Picture,
    Plot,
    Rows,
)
from identification.view.robot_drawing import robot_scene

SCARA, TX40 = (REPLAY / name / "session.mcap" for name in ("scara", "tx40"))
ARMS = {"scara": SCARA, "tx40": TX40, "emps": REPLAY / "emps" / "session.mcap"}


@pytest.mark.parametrize("log", [SCARA, TX40], ids=["scara", "tx40"])
@pytest.mark.parametrize("fitted", [True, False], ids=["fit", "recording"])
def test_torque_takes_upper_half(fitted, log, tmp_path):
    signals = signals_of(log)
    drawn = picture_of(ls_of(log)) if fitted else draw_recording(signals, Overrides())
    write_rrd(tmp_path / "a.rrd", drawn)
    seen, joints = opening_screen(tmp_path / "a.rrd"), [j.name for j in signals.robot.joints]
    assert set(seen) == {"/robot"} | {f"/{x}/{j}" for x in ("torque", "error") for j in joints}
    area = {view: at[2] * at[3] for view, at in seen.items()}
    assert sum(area[f"/torque/{joint}"] for joint in joints) == pytest.approx(0.5)
    for joint in joints:
        assert seen[f"/torque/{joint}"][[1, 3]].sum() <= 0.5 + 1e-9
        assert seen[f"/error/{joint}"][1] >= 0.5 - 1e-9
    assert area["/robot"] > 0.15


def shown(folder, *panels, groups=1):
    page = Page(name="page", groups={str(k): panels[k::groups] for k in range(groups)})
    picture = Picture(
        name="made up", document=Document(title="t", sections=()), pages=(page,), sha256={}
    )
    write_rrd(folder / "a.rrd", picture)
    return folder / "a.rrd"


def components(path, name):
    """Values of a component of the blueprint by the path of its entity."""
    reader = RrdReader(path)
    (blueprint,) = reader.blueprints()
    batches = (
        (chunk.entity_path, chunk.to_record_batch())
        for chunk in reader.stream(store=blueprint).to_chunks()
    )
    return {at: x.column(name).to_pylist()[0][0] for at, x in batches if name in x.schema.names}


ENDS = [
    (-5.5, 5.5), (0.1, 9.7), (-8.0, 3.0), (1.1, 1.9), (2.1, 2.4), (-4.5e-4, 5.1e-4), (0.0, 1.0),
    (31.0, 58.0), (-95.0, 4.0), (12.0, 19.0), (-2.6, 2.7), (0.0, 99.0),
]  # fmt: skip


@pytest.mark.parametrize(("low", "high"), ENDS, ids=str)
def test_two_ticks_in_every_plot(low, high, tmp_path):
    """The viewer has ticks at multiples of a power of ten and hides the texts of closer ones."""
    t_s = np.linspace(0.0, 1.0, 50)
    curves = [Curve(key="c", color=ORANGE, line=(t_s, np.linspace(low, high, 50)))]
    curves += [Curve(key="d", color=GREEN, line=(t_s, np.full(50, np.nan)))]
    plots = [Plot(path=("plot", str(k)), title=str(k), curves=tuple(curves)) for k in range(12)]
    found = components(shown(tmp_path, *plots, groups=2), "ScalarAxis:range")
    assert len(found) in (0, 12)
    first, last = next(iter(found.values()), (low, high))
    step = 10.0 ** np.ceil(
        np.log10((high - low) / 9)
    )  # of four rows each has a quarter of 36 ticks
    ticks = np.floor(last / step) - np.ceil(first / step) + 1
    assert 2 <= ticks <= 11
    assert first <= low < high <= last
    assert last - first <= 1.1 * max(high - low + step, 2 * step)
    if len(found):
        assert np.floor(high / step) - np.ceil(low / step) + 1 < 2, "else that of the viewer"


def test_constant_curve_has_viewer_axis(tmp_path):
    line = (np.array([0.0, 1.0]), np.array([2.0, 2.0]))
    plot = Plot(path=("a",), title="a", curves=(Curve(key="c", color=ORANGE, line=line),))
    assert components(shown(tmp_path, plot), "ScalarAxis:range") == {}


@pytest.mark.parametrize("arm", [*ARMS, *range(8)], ids=str)
def test_robot_fills_its_view(arm):
    """By a pinhole camera: 55° from top to bottom, the viewer's, in a view 1.2 times as wide."""
    if arm in ARMS:
        signals = signals_of(ARMS[arm])
    else:
        robot = random_arm(arm)
        q = np.random.default_rng(arm).uniform(-1.0, 1.0, (60, robot.n))
        signals = replace(
            made_up(), robot=robot, q=q, effort=q, t_s=np.arange(60) / 1000.0, events=(), health={}
        )
    scene = robot_scene(signals, None)
    forward = (scene.target - scene.eye) / np.linalg.norm(scene.target - scene.eye)
    right = np.cross(forward, scene.up) / np.linalg.norm(np.cross(forward, scene.up))
    above = np.cross(right, forward)
    places, _ = InverseModel(signals.robot).placements(signals.q[:: max(1, len(signals.q) // 300)])
    points = np.concatenate([np.zeros((1, 3)), places.reshape(-1, 3)]) - scene.eye
    depth = points @ forward
    # Shapes extend 0.1 m beyond the origins of their joints.
    sizes = [(np.abs(points @ axis) + 0.1) / depth for axis in (right, above)]
    sizes[0] /= 1.2
    assert (depth > 0).all()
    assert 0.9 < np.max(sizes) / np.tan(np.radians(55 / 2)) < 1.0
    assert above @ scene.up > 0.9


def test_intervals_at_their_values(tmp_path):
    """Of marks in Rerun: the ends of each interval and its value on one linear scale."""
    axis = Axis(low=-2.0, high=2.0, ticks={-2.0: "-2", 0.0: "0", 2.0: "+2"})
    marks = [
        Mark(row=0, value=-1.0, half=0.5, color=ORANGE),
        Mark(row=1, value=1.5, half=2.0, color=GREEN),
        Mark(row=1, value=0.5, color=ORANGE, shape="tick"),
        Mark(row=0, value=1.0, color=GREEN, shape="bar"),
    ]
    column = Column(head="head", axis=axis, marks=marks, lines=(1.0,))
    rows = Rows(path=("rows",), title="rows", names=[("a", ORANGE), ("b", GREEN)], columns=[column])
    static = Written(shown(tmp_path, rows)).static
    texts = dict(
        zip(
            static["/rows/texts"]["Points2D:labels"],
            static["/rows/texts"]["Points2D:positions"],
            strict=True,
        )
    )
    zero, unit = texts["0"][0], (texts["+2"][0] - texts["0"][0]) / 2
    assert texts["0"][0] - texts["-2"][0] == pytest.approx(2 * unit)
    assert texts["head"][0] == pytest.approx(zero)
    points = (np.array(static["/rows/points"]["Points2D:positions"]) - [zero, 0]) / [unit, 1]
    np.testing.assert_allclose(points[:, 0], [-1.0, 1.5], atol=1e-6)
    assert points[1, 1] - points[0, 1] == pytest.approx(texts["b"][1] - texts["a"][1])
    strips = np.array(static["/rows/lines"]["LineStrips2D:strips"])
    ends = {tuple(x) for x in np.round((strips[..., 0] - zero) / unit, 6)}
    # clipped to the axis, a tick in its place, a bar from zero, a line at its value
    assert {(-1.5, -0.5), (-0.5, 2.0), (0.5, 0.5), (0.0, 1.0), (1.0, 1.0)} <= ends
