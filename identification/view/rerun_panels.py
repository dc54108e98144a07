"""Renderer of a result as a Rerun file: series, events, the robot, and the report.

Charts are those of the HTML report.
"""

import hashlib
import re
import tempfile
import unicodedata
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.urdf import UrdfTree

from acquisition.files import atomic_write

from ..arrays import Array
from ..report import to_markdown
from .panels import GREY, LIGHT, SKY, Color, Log, Page, Panel, Picture, Plot, Rows, Scene

_GHOST, GRID = (*SKY, 70), (80, 80, 80)
# What the viewer's font lacks.
_NO_GLYPH = re.compile(r"[^\n\t -~¡-ÿΑ-ΡΣ-ω–—‘’“”…−√±×²³µ≤≥●○]")
ASIDE = ROBOT, PARAMETERS = "robot", "parameters"  # groups beside others
MAX_COLUMNS = 3  # plots side by side
MAX_TICKS = 36.0  # of a plot as high as a screen: the viewer hides the texts of closer ones
NAMES, WIDTH, PITCH = 110.0, 560.0, 18.0  # of rows of values: widths of names and all, height


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
        pages = [view for page in picture.pages if (view := _show_page(recording, page))]
        recording.send_blueprint(
            rrb.Blueprint(
                rrb.Tabs(
                    *pages, rrb.TextDocumentView(origin="report", name="report"), active_tab=0
                ),
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


def _show_page(recording: Any, page: Page) -> Any:
    """Show groups in tabs, or below each other; return None if Rerun shows none of them.

    The robot is beside the groups after the first, parameters beside all others.
    """
    columns = 1 if page.tabs else max(MAX_COLUMNS, -(-max(map(len, page.groups.values())) // 2))
    rows = [-(-len(x) // columns) for key, x in page.groups.items() if key not in ASIDE]
    ticks = MAX_TICKS / max((max if page.tabs else sum)(rows), 1)
    views = {
        key: seen
        for key, group in page.groups.items()
        if (seen := [view for x in group if (view := _show(recording, x, ticks)) is not None])
    }
    robot, name = views.pop(ROBOT, []), shown_text(page.name)
    beside = views.pop(PARAMETERS, []) if len(views) > 1 else []
    shares = [-(-len(group) // columns) for group in views.values()]
    grids = [
        rrb.Grid(*x, grid_columns=min(len(x), columns), name=shown_text(key))
        for key, x in views.items()
    ]
    if page.tabs:
        return rrb.Tabs(*grids, name=name)
    if robot:
        below = [rrb.Vertical(*grids[1:], row_shares=shares[1:]), *robot]
        grids, shares = [grids[0], rrb.Horizontal(*below, column_shares=[5, 3])], [1, 1]
    whole = rrb.Vertical(*grids, row_shares=shares, name=name) if grids else None
    return (
        rrb.Horizontal(whole, rrb.Vertical(*beside), column_shares=[3, 2], name=name)
        if beside
        else whole
    )


def _show(recording: Any, panel: Panel, ticks: float) -> Any:
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
                axis_y=_with_ticks(np.concatenate([c.line[1] for c in panel.curves]), ticks),
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
        case Rows():
            return _show_rows(recording, origin, panel)


def _with_ticks(x: Array, most: float) -> Any:
    """Return an axis of values with two to `most` ticks; None if that of the viewer has them.

    The viewer's ticks are powers of ten apart, so that its own range may have a single one.
    """
    low, high = np.nanmin(x, initial=np.inf), np.nanmax(x, initial=-np.inf)
    if not low < high:
        return None
    step = 10.0 ** np.ceil(np.log10((high - low) / most))
    ranges = [
        (min(low, tick), max(high, tick + step))
        for tick in step * np.arange(np.floor(low / step), np.ceil(high / step))
    ]
    first, last = min(ranges, key=lambda ends: float(np.ptp(ends)))
    margin = 0.04 * (last - first)
    return (
        None
        if (first, last) == (low, high)
        else rrb.ScalarAxis(range=(first - margin, last + margin))
    )


def _show_rows(recording: Any, origin: str, rows: Rows) -> Any:
    """Show values by row with their intervals, below the legend and the texts of the ticks."""
    bottom, step = PITCH * len(rows.names), (WIDTH - NAMES) / len(rows.columns)
    lines, points = list[tuple[Any, Color]](), list[tuple[float, float, Color]]()
    # The viewer writes below a point.
    texts = [(0.5 * NAMES, PITCH * k, *named) for k, named in enumerate(rows.names)]
    texts += [
        (WIDTH * (k + 0.5) / len(rows.legend), -4 * PITCH, *of) for k, of in enumerate(rows.legend)
    ]
    for k, column in enumerate(rows.columns):
        axis, ends = column.axis, (NAMES + step * k + 16, NAMES + step * (k + 1) - 16)
        ticks = axis.place([*axis.ticks], *ends).tolist()
        texts += [(sum(ends) / 2, -2.6 * PITCH, column.head, LIGHT)]
        texts += [
            (x, -1.3 * PITCH, text, GREY)
            for x, text in zip(ticks, axis.ticks.values(), strict=True)
        ]
        lines += [([(x, 0), (x, bottom)], GRID) for x in (*ticks, *axis.place(column.lines, *ends))]
        for mark in column.marks:
            y, start = PITCH * (mark.row + 0.5), mark.value - mark.half
            seen = [max(axis.low, 0.0) if mark.shape == "bar" else start, mark.value + mark.half]
            low, x, high = axis.place([seen[0], mark.value, seen[1]], *ends).tolist()
            up = 7.0 * (mark.shape == "tick")
            lines += [([(low, y), (high, y)], mark.color), ([(x, y - up), (x, y + up)], mark.color)]
            points += [(x, y, mark.color)] * (mark.shape not in ("bar", "tick"))
    for key, shown in (
        (
            "lines",
            rr.LineStrips2D(
                [x for x, _ in lines],
                colors=[color for _, color in lines],
                radii=[-0.5 if color == GRID else -1.5 for _, color in lines],  # in pixels
            ),
        ),
        (
            "points",
            rr.Points2D([x[:2] for x in points], colors=[x[2] for x in points], radii=-4.0),
        ),
        (
            "texts",
            rr.Points2D(
                [x[:2] for x in texts],
                labels=[shown_text(x[2]) for x in texts],
                colors=[x[3] for x in texts],
                radii=0.0,
                show_labels=True,
            ),
        ),
    ):
        recording.log(f"{origin}/{key}", shown, static=True)
    return rrb.Spatial2DView(
        origin=origin,
        name=shown_text(rows.title),
        visual_bounds=rrb.VisualBounds2D(x_range=(0, WIDTH), y_range=(-4.5 * PITCH, bottom)),
    )


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
    return _NO_GLYPH.sub(
        lambda found: (
            "'"
            if found[0] == "ᵀ"
            else _NO_GLYPH.sub("", unicodedata.normalize("NFKD", found[0])) or "?"
        ),
        text,
    )


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
