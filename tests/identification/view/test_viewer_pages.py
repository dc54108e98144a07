"""The rest of the Rerun files: robots, sessions, recordings not fitted, two fits side by
side, and the commands.
"""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from command_runs import refused, run
from conftest import REPLAY, robot_named
from fits_of_records import picture_of
from pictured_fits import Written, fitted, fitted_iv, made_up, scara, urdf_robot, values
from scipy.spatial.transform import Rotation

from acquisition.recording import Event
from identification.errors import BadInputError
from identification.model import InverseModel
from identification.regression import Overrides
from identification.report import Parameter, ParameterSet, comparison_section, differences
from identification.view import draw_recording, write_rrd
from identification.view.curves import column_plots
from identification.view.recording_panels import event_logs, health_plots
from identification.view.rerun_panels import shown_text
from identification.view.robot_drawing import pose_stride, robot_scene

SESSION = REPLAY / "scara" / "session.mcap"


def written(folder, picture):
    write_rrd(folder / "a.rrd", picture)
    return Written(folder / "a.rrd")


@pytest.mark.parametrize("name", ["tx40", "emps"])
def test_robot_drawn_from_table(name):
    robot = robot_named(name)
    q = 0.2 * np.cumsum(np.random.default_rng(1).standard_normal((400, robot.n)), axis=0) / 20
    signals = replace(
        made_up(),
        t_s=np.arange(400) / 1000.0,
        q=q,
        effort=np.zeros_like(q),
        robot=robot,
        events=(),
        health={},
    )
    scene = robot_scene(signals, None)
    links = ET.fromstring(scene.urdf).findall("link")
    assert len(links) == robot.n + 1
    assert all(link.find("visual/geometry") is not None for link in links), (
        "base and every link have something to show"
    )
    (robot_shown,) = scene.robots
    assert np.diff(robot_shown.t_s).min() > 0.99 / 50
    model = pin.buildModelFromXML(scene.urdf)
    order = [model.joints[model.getJointId(joint)].idx_v for joint in scene.joints]
    data, places = model.createData(), InverseModel(robot).placements(robot_shown.q)[0]
    for qk, expected in zip(robot_shown.q, places, strict=True):
        moved = np.zeros(model.nv)
        moved[order] = qk
        pin.forwardKinematics(model, data, pin.integrate(model, pin.neutral(model), moved))
        at = [data.oMi[model.getJointId(joint)].translation for joint in scene.joints]
        np.testing.assert_allclose(at, expected, atol=1e-9)


def test_poses_limited_to_screen():
    assert pose_stride(45_000, 5000.0) == 100
    assert pose_stride(100, 20.0) == 1
    assert 10_000_000 / pose_stride(10_000_000, 1000.0) <= 15_000


@pytest.fixture
def mesh(tmp_path):
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.4]], dtype="<f4")
    faces = np.zeros(
        4, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    )
    faces["corners"] = corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    file = tmp_path / "src" / "arm" / "meshes" / "l.STL"
    file.parent.mkdir(parents=True)
    file.write_bytes(bytes(80) + np.uint32(4).tobytes() + faces.tobytes())
    return file


PLACES = {  # name of the mesh, environment, whether it is found
    "a box": ("", {}, True),
    "file": ("file://{mesh}", {}, True),
    "package among sources": (
        "package://arm/meshes/l.STL",
        {"ROS_PACKAGE_PATH": "/nowhere:{src}"},
        True,
    ),
    "installed package": ("package://arm/meshes/l.STL", {"AMENT_PREFIX_PATH": "{src}"}, True),
    "relative name": ("meshes/l.STL", {}, False),
    "not a mesh": ("file://{mesh}.txt", {}, False),
}


@pytest.mark.parametrize("place", PLACES)
def test_urdf_shows_shapes_and_found_meshes(place, mesh, tmp_path, monkeypatch, capfd):
    name, variables, found = PLACES[place]
    mesh.with_name("l.STL.txt").write_text("text")
    folder = tmp_path / "src"
    if "AMENT_PREFIX_PATH" in variables:
        (folder / "share").mkdir()
        (folder / "arm").rename(folder / "share" / "arm")
    for variable in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.setenv(variable, variables.get(variable, "").format(src=folder))
    # a relative name is not relative to this
    monkeypatch.chdir(mesh.parents[1] if mesh.exists() else tmp_path)
    robot = urdf_robot(
        f"<mesh filename='{name.format(mesh=mesh)}'/>" if name else "<box size='.1 .1 .4'/>"
    )
    collision = (
        "<collision><geometry><mesh filename='/nowhere/c.stl'/></geometry></collision></link>"
    )
    robot = replace(robot, urdf=robot.urdf.replace("</link>", collision))
    file = written(
        tmp_path,
        draw_recording(replace(made_up(types=("revolute", "revolute")), robot=robot), Overrides()),
    )
    assert name or file.is_complete()
    own = [
        columns
        for path, columns in file.static.items()
        if "/robot/measured/visual_geometries/l2" in path
    ]
    assert (len(own) > 0) == found
    assert any(any(name.startswith("Asset3D:blob") for name in columns) for columns in own) == (
        found and name != ""
    )
    made = any("/robot/measured/visual_geometries/link_2" in path for path in file.static)
    assert made != found, "lines where the mesh is not found"
    moved = [path for path, columns in file.moving.items() if "Transform3D:quaternion" in columns]
    assert len(moved) == 2, "one for each joint"
    assert capfd.readouterr() == ("", "")


def test_both_robots_follow_their_data(tmp_path):
    signals = scara()
    fit = fitted_iv(signals)
    file, motion = written(tmp_path, picture_of(fit)), fit.recordings[0].simulated.motion
    for key, t_s, q in (("measured", signals.t_s, signals.q), ("simulated", motion.t_s, motion.q)):
        first, second = (file.moving[f"/robot/{key}/joints/{j}"] for j in (1, 2))
        at = np.array([t.total_seconds() for t in first["time"]])
        k = np.array([np.abs(t_s - t).argmin() for t in at])
        places, _ = InverseModel(signals.robot).placements(q[k])
        turns = Rotation.from_quat(np.array(first["Transform3D:quaternion"])[:, 0])
        elbow = np.array(first["Transform3D:translation"])[:, 0]
        elbow = elbow + turns.apply(np.array(second["Transform3D:translation"])[:, 0])
        np.testing.assert_allclose(elbow, places[:, 1], atol=1e-6)
    # Never at the origin for want of a pose.
    assert file.moving["/robot/simulated/joints/2"]["time"][0].total_seconds() == 0.0


def event(t_s, **values):
    return Event(stamp_ns=round(1e9 * t_s), **values)


def test_session_events_and_counters_shown(tmp_path):
    t_s = np.array([-1.0, 0.0, 1.0, 2.0, 99.0])
    phases = [(-3.0, "configure"), (-1.0, "settle"), (0.5, "track"), (99.0, "stop")]
    events = [event(t_s=at, kind="phase", text=text) for at, text in phases]
    events.insert(3, event(t_s=1.0, kind="fault", text="drive 2: following error"))
    health = {
        "frames": (t_s, 100 * t_s),
        "late": (t_s, np.array([0, 0, 2, 2, 3.0])),
        "lost": (t_s, t_s * np.nan),
    }
    signals = replace(made_up(), events=tuple(events), health=health)
    file = written(tmp_path, picture_of(fitted(signals)))
    assert file.is_complete()
    assert "TextLog" in {kind for kind, _ in file.views.values()}
    (log,), (plot,) = event_logs(signals), health_plots(signals)
    assert log.lines[0] == (0.0, False, "-3.000 s  phase: configure (before the samples)")
    assert log.lines[3] == (1.0, True, "1.000 s  fault: drive 2: following error")
    assert plot.title == "fault counters: late 3"
    assert "- recorder: frames 9900, late 3\n" in file.static["/report"]["TextDocument:text"][0]
    ((late, counts),) = [c.line for c in plot.curves]
    np.testing.assert_allclose(late, [0.0, 0.0, 1.0, 2.0, signals.t_s[-1]])
    np.testing.assert_allclose(counts, [0, 0, 2, 2, 3])


def test_extra_columns_on_signal_view():
    plain = made_up(types=("revolute", "prismatic"))
    robot = plain.robot
    columns = {
        name: k + plain.q for k, name in enumerate(("velocity", "known_torque", "feedforward"), 1)
    }
    whole = replace(plain, **columns)
    joints, motors = [j.name for j in robot.joints], [m.name for m in robot.motors]
    plots = column_plots(whole)
    assert [plot.title for plot in plots[:2]] == ["velocity measured", "external torque"]
    assert [curve.name for curve in plots[0].curves] == [
        f"{joints[0]} [rad/s]",
        f"{joints[1]} [m/s]",
    ]
    assert [curve.name for curve in plots[1].curves] == [f"{joints[0]} [N m]", f"{joints[1]} [N]"]
    for plot, name, keys in zip(plots, columns, (joints, joints, motors), strict=True):
        assert [curve.key for curve in plot.curves] == keys
        for c, curve in enumerate(plot.curves):
            t_s, x = curve.line
            np.testing.assert_array_equal(x, columns[name][np.searchsorted(plain.t_s, t_s), c])
            assert x.max() == columns[name][:, c].max()
    alike = made_up(types=("revolute", "revolute"))
    only, other = column_plots(replace(alike, known_torque=alike.q, feedforward=alike.q))
    assert (only.path, only.title) == (("column", "known_torque"), "external torque [N m]")
    assert other.title == f"feed-forward [{alike.robot.motors[0].recorded_unit}]"
    for signals, shown in ((whole, 3), (plain, 0)):
        (page,) = (
            page for page in draw_recording(signals, Overrides()).pages if page.name == "signal"
        )
        assert len(page.groups["column"]) == shown


@pytest.mark.parametrize(
    ("case", "N"), [({"types": ("prismatic",), "reference": True}, 4000), ({}, 2)], ids=str
)
def test_unfitted_recording_shown(case, N, tmp_path):
    signals = made_up(**case)
    signals = replace(signals, t_s=signals.t_s[:N], q=signals.q[:N], effort=signals.effort[:N])
    file = written(tmp_path, draw_recording(signals, Overrides()))
    assert file.is_complete()
    kinds = [kind for kind, _ in file.views.values()]
    assert kinds.count("TimeSeries") == signals.robot.n * (4 + (signals.q_ref is not None))
    assert "3D" in kinds
    assert ("cannot be fitted" in file.static["/report"]["TextDocument:text"][0]) == (N < 4000)


def test_differences_in_their_standard_errors():
    a, b = (
        values("A", M1=(2.0, 0.3), M2=(1.0, 0.0), M4=(1.0, 0.1)),
        values("B", M1=(1.0, 0.4), M2=(1.0, 0.0), M3=(5.0, 1.0)),
    )
    rows = {row.name: row for row in differences(a, b)}
    assert list(rows) == ["M1", "M2", "M4", "M3"]
    assert rows["M1"].off_sigma == pytest.approx(2.0)
    assert rows["M1"].off_percent == pytest.approx(100.0)
    assert rows["M2"].off_sigma is None
    assert (rows["M3"].a, rows["M3"].off, rows["M4"].b) == (None, None, None)
    by_name, _, *alone = comparison_section(a, b).lines
    assert "matched by name" in by_name
    assert alone == ["Only in A: M4.", "Only in B: M3."]
    with pytest.raises(BadInputError, match="no parameter in common"):
        differences(a, values("C", M9=(1.0, 1.0)))


def test_intervals_preferred_as_standard_errors():
    """Intervals of 2.0 ± 0.6 and 1.0 ± 0.8: the difference is one of two whose halves add up to
    1, so 1.96 deviations.
    """
    a = Parameter(name="M1", value=2.0, low=1.4, high=2.6, unit="kg", sigma=0.01)
    b = Parameter(name="M1", value=1.0, low=0.2, high=1.8, unit="kg", sigma=5.0)
    (row,) = differences(
        ParameterSet(label="A", parameters={"M1": a}), ParameterSet(label="B", parameters={"M1": b})
    )
    assert row.off_sigma == pytest.approx(1.96)
    without = Parameter(name="M1", value=1.0, unit="kg", sigma=0.2)
    assert (without.half, without.spread) == (pytest.approx(1.96 * 0.2), pytest.approx(0.2))
    # in files of earlier versions
    earlier = Parameter(name="M1", value=1.0, unit="kg", sigma=0.2, sigma_hac=0.3)
    assert earlier.spread == pytest.approx(0.3)
    assert Parameter(name="M1", value=1.0, unit="kg").half == 0


def test_text_uses_viewer_font_only(tmp_path):
    """The viewer's font is Inter alone; the viewer ends at a character without a glyph."""
    assert shown_text("cond ZᵀW, σ ± 2 µrad²/√Hz − é") == "cond Z'W, σ ± 2 µrad²/√Hz − é"
    assert shown_text("Ｊ１ 関節") == "J1 ??"
    signals = scara()
    joints = (
        msgspec.structs.replace(j, name=f"関節 {k}") for k, j in enumerate(signals.robot.joints)
    )
    signals = replace(signals, robot=replace(signals.robot, joints=tuple(joints)))
    file = written(tmp_path, picture_of(fitted_iv(signals)))
    texts = [title for _, title in file.views.values()]
    texts += file.static["/report"]["TextDocument:text"]
    for columns in file.static.values():
        texts += columns.get("SeriesLines:names") or []
    assert any("Z'W" in text for text in texts)
    assert all(shown_text(text) == text for text in texts)


def test_command_view(capsys, tmp_path):
    rrd, page = tmp_path / "view.rrd", tmp_path / "view.html"
    status, out, err = run(capsys, "view", SESSION, "-o", rrd)
    assert (status, err, f"rerun --bind 127.0.0.1 {rrd}" in out) == (0, "", True)
    assert Written(rrd).is_complete()
    status, out, _ = run(capsys, "view", SESSION, "-o", page)
    assert (status, out) == (0, f"open the report: {page} in a browser\n")
    assert "position [rad/√Hz] over frequency [Hz]" in page.read_text()
    assert refused(capsys, "view", SESSION, "--follow", "-o", page).endswith(
        "expected FILE.rrd with --follow\n"
    )


def test_incomparable_fits_refused(capsys, tmp_path):
    def fit(name, parameter, unit):
        parameters = [{"name": parameter, "value": 1.0, "sigma": 0.1, "unit": unit}]
        content = {"format": 1, "method": "wls", "status": "solved", "parameters": parameters}
        (tmp_path / name).write_text(json.dumps(content))
        return tmp_path / name

    a = fit("a.json", "M1", "kg")
    for b, message in (
        (fit("b.json", "M2", "kg"), "no parameter in common"),
        (fit("c.json", "M1", "V s²/m"), "c: M1.unit = 'V s²/m': expected kg, as in a"),
        (tmp_path / "none.json", "cannot be read"),
    ):
        assert message in refused(capsys, "compare", a, b)
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps({"parameters": [{"name": "M1", "value": 1.3, "unit": "kg"}]}))
    status, out, _ = run(capsys, "compare", a, truth)
    assert (status, "-3.00" in out) == (0, True)
    assert "the output is also an input" in refused(capsys, "compare", a, a, "--json", a)
