"""Renderer of a result as a Rerun file: series, events, the robot, and the report.

Charts are those of the HTML report.
"""

import hashlib
import re
import tempfile
import unicodedata
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.urdf import UrdfTree

from acquisition.files import atomic_write

from ..arrays import Array
from ..report import to_markdown
from .panels import SKY, Log, Page, Panel, Picture, Plot, Scene

_GHOST = (*SKY, 70)
_SIGNS = "–—‘’“”…−√±×²³µ≤≥"  # signs in use here that the viewer's font has
ROBOT, MAX_COLUMNS = "robot", 3  # the group beside the others; plots side by side


def write_rrd(path: Path, picture: Picture) -> None:
    """Write a result as a Rerun file with its own layout (`rerun FILE.rrd`), paused at its start.

    The viewer stores one layout per application: the digest of the report makes each file an
    application of its own.

    Raises
    ------
    BadInputError : the file cannot be written.
    """
    # Rerun warns about other characters in the name of an application.
    named, report = re.sub(r"[^A-Za-z0-9 _-]+", "-", picture.name), to_markdown(picture.document)
    recording = rr.RecordingStream(f"{named} {hashlib.sha256(report.encode()).hexdigest()[:8]}")
    # Collect the file in memory, so that disk errors are raised by write_bytes below.
    stream = recording.binary_stream()
    try:
        recording.send_recording_name(shown_text(picture.name))
        recording.log(
            "report", rr.TextDocument(shown_text(report), media_type="text/markdown"), static=True
        )
        text, tabs = [rrb.TextDocumentView(origin="report", name="report")], []
        for page in picture.pages:
            views = {
                key: [view for panel in group if (view := _show(recording, panel))]
                for key, group in page.groups.items()
            }
            if any(views.values()):
                tabs.append(_arrange(page, views, text))
                text = []  # stands beside the first page
        recording.send_blueprint(
            rrb.Blueprint(
                rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else rrb.Vertical(*tabs, *text),
                rrb.TimePanel(
                    state="collapsed", timeline="time", loop_mode="all", play_state="Paused"
                ),
                collapse_panels=True,
                auto_views=False,
                auto_layout=False,
            )
        )
    finally:
        content = stream.read()  # also after a failure: rerun warns about unread data
        recording.disconnect()
    with atomic_write(path) as file:
        file.write_bytes(content)


def _arrange(page: Page, views: Mapping[str, Sequence[Any]], text: Sequence[Any]) -> Any:
    """Arrange a view.

    Its groups are below each other or in tabs; beside them are the robot and the report.
    """
    main = {key: group for key, group in views.items() if group and key != ROBOT}
    columns = 1 if page.tabs else MAX_COLUMNS
    grids = [
        rrb.Grid(*x, grid_columns=min(len(x), columns), name=shown_text(key))
        for key, x in main.items()
    ]
    parts = [
        rrb.Tabs(*grids)
        if page.tabs
        else rrb.Vertical(*grids, row_shares=[-(-len(group) // columns) for group in main.values()])
    ]
    side = [*views.get(ROBOT, ()), *text]
    parts += [rrb.Vertical(*side, row_shares=[2, 3][-len(side) :])] if side else []
    return rrb.Horizontal(*parts, column_shares=[5, 2][: len(parts)], name=shown_text(page.name))


def _show(recording: Any, panel: Panel) -> Any:
    """Write a panel's data as entities under its path; return their view, None for a chart."""
    origin, title = rr.new_entity_path(list(panel.path)), shown_text(panel.title)
    match panel:
        case Plot():
            for c in panel.curves:
                entity = f"{origin}/{rr.new_entity_path([c.key]).lstrip('/')}"
                name, columns = shown_text(c.name or c.key), rr.Scalars.columns(scalars=c.line[1])
                # By default Rerun averages the values of one pixel, which loses peaks.
                recording.log(
                    entity,
                    rr.SeriesLines(
                        names=name,
                        colors=c.color,
                        widths=c.width,
                        aggregation_policy="MinMax",
                    ),
                    static=True,
                )
                recording.send_columns(entity, indexes=[_time(c.line[0])], columns=columns)
            return rrb.TimeSeriesView(
                origin=origin,
                name=title,
                axis_x=rrb.TimeAxis(link="LinkToGlobal"),
                plot_legend=rrb.PlotLegend(visible=panel.legend),
            )
        case Log():
            recording.send_columns(
                origin,
                indexes=[_time(np.array([t_s for t_s, _, _ in panel.lines]))],
                columns=rr.TextLog.columns(
                    text=[shown_text(text) for _, _, text in panel.lines],
                    level=["WARN" if warning else "INFO" for _, warning, _ in panel.lines],
                ),
            )
            return event_view(origin, title)
        case Scene():
            return _show_robot(recording, origin, panel)


def event_view(origin: str, title: str) -> Any:
    """Return a view of texts that repeat their times.

    The viewer cuts the times of its own column to four letters.
    """
    return rrb.TextLogView(
        origin=origin,
        name=title,
        columns=rrb.TextLogColumns(
            timeline_columns=[rrb.encodings.TimelineColumn("time", visible=False)],
            text_log_columns=["LogLevel", "Body"],
        ),
    )


def shown_text(text: str) -> str:
    """Return text in the viewer's font: similar characters, or question marks.

    Outside of its font the viewer stops with an error.
    """
    return "".join(c if _has_glyph(c) else _replace_glyph(c) for c in text)


def _has_glyph(c: str) -> bool:
    return (
        c in "\n\t"
        or " " <= c <= "~"
        or "¡" <= c <= "ÿ"
        or ("Α" <= c <= "ω" and c.isalpha())
        or c in _SIGNS
    )


def _replace_glyph(c: str) -> str:
    similar = "".join(x for x in unicodedata.normalize("NFKD", c) if _has_glyph(x))
    return "'" if c == "ᵀ" else similar or "?"


def _time(t_s: Array) -> Any:
    """Return times on the timeline `time`."""
    return rr.TimeColumn("time", duration=np.rint(1e9 * t_s).astype("timedelta64[ns]"))


def _show_robot(recording: Any, origin: str, scene: Scene) -> Any:
    """Show robots drawn by the URDF, and the motion of their joints."""
    for robot in scene.robots:
        tree = _urdf_tree(scene.urdf, origin, robot.key, ghost=robot.ghost)
        tree.log_urdf_to_recording(recording)
        recording.log(
            f"{origin}/{robot.key}/root",
            rr.Transform3D(
                parent_frame=f"tf#{origin}",
                child_frame=f"{robot.key}/{tree.root_link().name.removeprefix(f'{robot.key}/')}",
            ),
            static=True,
        )
        for j, name in enumerate(scene.joints):
            if (joint := tree.get_joint_by_name(name)) is not None:
                recording.send_columns(
                    f"{origin}/{robot.key}/joints/{j + 1}",
                    indexes=[_time(robot.t_s)],
                    columns=joint.compute_transform_columns(robot.q[:, j].tolist(), clamp=False),
                )
    return rrb.Spatial3DView(
        origin=origin,
        name=shown_text(scene.title),
        line_grid=rrb.LineGrid3D(
            plane=rr.components.Plane3D(scene.up, scene.floor), color=(120, 120, 120, 60)
        ),
        eye_controls=rrb.EyeControls3D(
            position=scene.eye, look_target=scene.target, eye_up=scene.up
        ),
    )


def _urdf_tree(text: str, origin: str, key: str, *, ghost: bool) -> UrdfTree:
    """Return the tree of a URDF with frames of its own for this robot; a ghost has one color."""
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
