"""Write panels to Rerun: `show` logs the data of a panel as entities and returns their view."""

import hashlib
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from copy import copy
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.urdf import UrdfTree

from acquisition.files import atomic_write

from ..arrays import Array
from ..report import to_markdown
from .panels import GREY, RESIDUAL, SKY, Bars, Chart, Color, Curve, Lanes, Log, Note, Panel, Picture, Plot, Scene
from .rerun_layout import arrange, shown_text

_GHOST = (*SKY, 70)
_HALF_WIDTH = 3.2  # of a marker, in pixels of the sheet
_DIAGONALS = np.array([[[-1.0, -1.0], [1.0, 1.0]], [[-1.0, 1.0], [1.0, -1.0]]])
_CIRCLE = np.stack([np.cos(np.linspace(0, 2 * np.pi, 13)), np.sin(np.linspace(0, 2 * np.pi, 13))], axis=1)[None]


def write_rrd(path: Path, picture: Picture) -> None:
    """Write a picture as a Rerun file with its own layout (`rerun FILE.rrd`), paused at its start.

    The viewer stores one layout per application: the digest of the report makes each file an application of its own.
    Raises `AcquisitionError`: the file cannot be written.
    """
    named = re.sub(r"[^A-Za-z0-9 _-]+", "-", picture.name)  # other characters make Rerun rename it and warn
    recording = rr.RecordingStream(f"{named} {hashlib.sha256(to_markdown(picture.document).encode()).hexdigest()[:8]}")
    stream = recording.binary_stream()  # in memory: disk errors are then raised by write_bytes below
    try:
        recording.send_recording_name(shown_text(picture.name))
        shown: dict[tuple[str, ...], Any] = {}  # a panel on several pages is written once

        def show_once(panel: Panel) -> Any:
            if panel.path not in shown:
                shown[panel.path] = show(recording, panel)
            view = copy(shown[panel.path])
            view.id = uuid4()  # the viewer refuses a view under two parents
            return view

        tabs = [arrange(page, show_once) for page in picture.pages if any(page.groups.values())]
        panels = [panel for page in picture.pages for group in page.groups.values() for panel in group]
        state = "collapsed" if any(isinstance(panel, Plot | Scene) for panel in panels) else "hidden"
        blueprint = rrb.Blueprint(
            rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else tabs[0],
            rrb.TimePanel(state=state, timeline=picture.timeline, loop_mode="all", play_state="Paused"),
            collapse_panels=True,
            auto_views=False,
            auto_layout=False,
        )
        recording.send_blueprint(blueprint)
    finally:
        content = stream.read()  # also after a failure: rerun warns about unread data
        recording.disconnect()
    with atomic_write(path) as file:
        file.write_bytes(content)


def show(recording: Any, panel: Panel) -> Any:
    """Write a panel's data as entities under its path; return their view."""
    origin, title = rr.new_entity_path(list(panel.path)), shown_text(panel.title)

    def log(key: str, what: Any) -> None:
        recording.log(f"{origin}/{key}" if key else origin, what, static=True)

    def log_points(key: str, points: Sequence[tuple[float, float, Color]], radius: float, order: float) -> None:
        if points:
            xy, colors = zip(*(((x, y), color) for x, y, color in points), strict=True)
            log(key, rr.Points2D(xy, colors=colors, radii=rr.Radius.ui_points(radius), draw_order=order))

    def log_outlines(key: str, points: Sequence[tuple[float, float, Color]], strips: Array) -> None:
        if points:
            at = (np.array([point[:2] for point in points])[:, None, None] + _HALF_WIDTH * strips).reshape(
                -1, *strips.shape[1:]
            )
            colors = [color for _, _, color in points for _ in strips]
            log(key, rr.LineStrips2D(at, colors=colors, radii=rr.Radius.ui_points(0.8), draw_order=40.0))

    match panel:
        case Plot():
            for c in panel.curves:
                key = rr.new_entity_path([c.key]).lstrip("/")
                name, columns = shown_text(c.name or c.key), rr.Scalars.columns(scalars=c.line[1])
                style = {"names": name, "colors": c.color, "widths": c.width, "visible_series": c.visible}
                # By default Rerun averages the values of one pixel, which loses peaks.
                log(key, rr.SeriesLines(**style, aggregation_policy="MinMax"))
                recording.send_columns(f"{origin}/{key}", indexes=[_time(c.line[0], panel.start)], columns=columns)
            legend = rrb.PlotLegend(corner=_emptiest_corner(panel.curves), visible=panel.legend)
            axis = rrb.TimeAxis(link="LinkToGlobal")
            return rrb.TimeSeriesView(origin=origin, name=title, axis_x=axis, plot_legend=legend)
        case Bars():
            names = (name.replace(" ", "_") for name in panel.names[::-1])
            for key, steps, color in zip(names, (panel.back, panel.front), ((*GREY, 120), RESIDUAL), strict=True):
                left, width, heights = steps
                log(key, rr.BarChart(heights, abscissa=left, widths=np.full(len(left), width), color=color))
            return rrb.BarChartView(origin=origin, name=title, plot_legend=rrb.PlotLegend(visible=panel.legend))
        case Chart():
            xy, texts, colors = zip(*(((x, y), shown_text(text), c) for x, y, text, c in panel.labels), strict=True)
            hidden = rr.Radius.ui_points(0.1)
            log("labels", rr.Points2D(xy, labels=texts, colors=colors, radii=hidden, show_labels=True))
            strips, colors, radii = zip(*panel.strokes, strict=True)
            log("strokes", rr.LineStrips2D(strips, colors=colors, radii=rr.Radius.ui_points(radii)))
            log_points("dots", panel.dots, 3.0, 50.0)
            log_points("cloud", panel.cloud, 1.5, 10.0)
            log_outlines("crosses", panel.crosses, _DIAGONALS)
            log_outlines("rings", panel.rings, _CIRCLE)
            bounds = rrb.VisualBounds2D(x_range=[0, panel.size[0]], y_range=[0, panel.size[1]])
            return rrb.Spatial2DView(origin=origin, name=title, visual_bounds=bounds)
        case Lanes():
            for name, bands in panel.lanes.items():
                key, changes = rr.new_entity_path([name]).lstrip("/"), [shown_text(text) for _, text, _ in bands]
                known = {text: color for text, (_, _, color) in zip(changes, bands, strict=True)}
                visible = [bool(text) for text in known]
                log(key, rr.StateConfiguration(values=list(known), colors=list(known.values()), visible=visible))
                times, columns = _time(np.array([t_s for t_s, _, _ in bands])), rr.StateChange.columns(state=changes)
                recording.send_columns(f"{origin}/{key}", indexes=[times], columns=columns)
            return rrb.StateTimelineView(origin=origin, name=title)
        case Log():
            times = _time(np.array([t_s for t_s, _, _ in panel.lines]))
            levels = ["WARN" if warning else "INFO" for _, warning, _ in panel.lines]
            columns = rr.TextLog.columns(text=[shown_text(text) for _, _, text in panel.lines], level=levels)
            recording.send_columns(origin, indexes=[times], columns=columns)
            columns_shown = rrb.TextLogColumns(timeline_columns=["time"], text_log_columns=["LogLevel", "Body"])
            return rrb.TextLogView(origin=origin, name=title, columns=columns_shown)
        case Note():
            log("", rr.TextDocument(shown_text(to_markdown(panel.document)), media_type="text/markdown"))
            return rrb.TextDocumentView(origin=origin, name=title)
        case Scene():
            return _show_robot(recording, origin, panel)


def _time(t_s: Array, start: datetime | None = None) -> Any:
    """Times on the timeline `time`, or with a start on `date`."""
    times = np.rint(1e9 * t_s).astype("timedelta64[ns]")
    if start is None:
        return rr.TimeColumn("time", duration=times)
    return rr.TimeColumn("date", timestamp=np.datetime64(start.astimezone(UTC).replace(tzinfo=None), "ns") + times)


def _emptiest_corner(curves: Sequence[Curve]) -> str:
    """The corner where a legend covers the fewest samples."""
    t, x = (np.concatenate([c.line[i] for c in curves if c.visible]) for i in (0, 1))
    right, left = t > t.min() + 0.72 * np.ptp(t), t < t.min() + 0.28 * np.ptp(t)
    top, bottom = x > x.min() + 0.65 * np.ptp(x), x < x.min() + 0.35 * np.ptp(x)
    corners = {
        "RightTop": right & top,
        "RightBottom": right & bottom,
        "LeftTop": left & top,
        "LeftBottom": left & bottom,
    }
    return min(corners, key=lambda corner: int(corners[corner].sum()))


def _show_robot(recording: Any, origin: str, scene: Scene) -> Any:
    """Robots drawn by the URDF, and the motion of their joints."""
    for robot in scene.robots:
        tree = _urdf_tree(scene.urdf, origin, robot.key, ghost=robot.ghost)
        tree.log_urdf_to_recording(recording)
        root = f"{robot.key}/{tree.root_link().name.removeprefix(f'{robot.key}/')}"
        fixed = rr.Transform3D(parent_frame=f"tf#{origin}", child_frame=root)
        recording.log(f"{origin}/{robot.key}/root", fixed, static=True)
        for j, name in enumerate(scene.joints):
            if (joint := tree.get_joint_by_name(name)) is not None:
                columns = joint.compute_transform_columns(robot.q[:, j].tolist(), clamp=False)
                path = f"{origin}/{robot.key}/joints/{j + 1}"
                recording.send_columns(path, indexes=[_time(robot.t_s)], columns=columns)
    grid = rrb.LineGrid3D(plane=rr.components.Plane3D(scene.up, scene.floor), color=(120, 120, 120, 60))
    eye = rrb.EyeControls3D(position=scene.eye, look_target=scene.target, eye_up=scene.up)
    return rrb.Spatial3DView(origin=origin, name=shown_text(scene.title), line_grid=grid, eye_controls=eye)


def _urdf_tree(text: str, origin: str, key: str, *, ghost: bool) -> UrdfTree:
    """The tree of a URDF with frames of its own for this robot; a ghost has one color."""
    root = ET.fromstring(text)
    root.set("name", key)  # entities are below origin/key, since the prefix is one part of a path
    for visual in root.iter("visual") if ghost else ():
        for material in visual.findall("material"):
            visual.remove(material)
        material = ET.SubElement(visual, "material", {"name": "ghost"})
        ET.SubElement(material, "color", {"rgba": " ".join(f"{c / 255:.3f}" for c in _GHOST)})
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "robot.urdf"
        file.write_bytes(ET.tostring(root))
        return UrdfTree.from_file_path(
            file,
            entity_path_prefix=origin.lstrip("/"),
            frame_prefix=f"{key}/",
            static_transform_entity_path=f"{origin}/{key}/fixed",
        )
