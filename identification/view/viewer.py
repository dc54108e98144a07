"""A recording, its fit, or two fits as a Rerun file that opens with its own layout. The only file that imports rerun.

What is shown is plain data of `panels`. `_show` writes one of these into the file and returns the
panel that shows it, and the layout is built of such panels only: none can be without data.
"""

import hashlib
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.urdf import UrdfTree

from acquisition.files import whole_file

from ..data import Signals
from ..errors import IdentificationError
from ..methods import Fit
from ..regression import Overrides, Settings, make_settings
from ..report import (
    Document,
    Values,
    comparison_document,
    comparison_section,
    fit_document,
    recording_document,
    to_markdown,
    true_values,
    values_of_fit,
)
from ..study import Run
from .charts import parameter_drawing, passes_drawing, spectrum_drawings, study_drawing, trust_drawing
from .curves import motion_plots, observed, residual_bars, torque_plot, tracking_plot
from .legend import fit_legend, recording_legend
from .panels import BLUE, GREY, RED, Bars, Curve, Drawing, Lanes, Log, Note, Panel, Plot, Scene, Solid
from .robot_drawing import robot_scene
from .session_panels import event_log, health_plot, span_lanes

Vector = NDArray[np.float64]

_SOLID_COLORS = {"base": (95, 100, 110), "link": (215, 218, 224), "joint": (70, 78, 92), "tool": (235, 160, 60)}
_GHOST, _HALO = (*BLUE, 70), 1.07  # a ghost's color, and its size, so that it shows around the robot it covers


def write_fit_rrd(
    path: Path, signals: Signals, fit: Fit, *, beside: Fit | None = None, truth: Vector | None = None
) -> None:
    """Write a fit as a Rerun file that opens with its own layout (`rerun fit.rrd`).

    `beside` is another fit of the same recording, such as least squares beside instrumental variables; `truth` (b,) are
    known values of the base parameters. Times are seconds from the recording's first sample, on the timeline `time`.
    Measured curves span the recording, filtered and predicted ones what the fit used of it. Entities are
    `q/<joint>/measured`, `measured_filtered`, `reference`, `simulated`, and so for `dq` and `ddq`;
    `torque/<joint>/measured`, `model_idm`, `model_ddm`, `residual`; `error`, `robot`, `parameters`, `trust`, `passes`,
    `residual`, `spectrum`, `session`, `events`, `health`, `report`.
    Raises `AcquisitionError`, one line, when the file cannot be written; nothing is left behind then.
    """
    # A viewer holds one layout per application, and titles here carry results: each fit is an application of its own.
    compared = (beside.estimate.beta.tobytes() if beside else b"") + (truth.tobytes() if truth is not None else b"")
    told = f"{signals.sha256} {fit.method} {fit.settings} {fit.estimate.names} {fit.estimate.beta.tobytes()!r} {compared!r}"
    name = f"{signals.recording}, {fit.method.upper()}"

    def pages(show: "_Show") -> list[Any]:
        return _fit_pages(show, signals, fit, beside, truth)

    _write(path, signals.robot.name, told, name, pages)


def write_recording_rrd(path: Path, signals: Signals, overrides: Overrides) -> None:
    """Write a recording that has not been fitted as a Rerun file, with the panels of a fit that need none.

    Entities and errors as in `write_fit_rrd`.
    """
    refusal, plan = None, None
    try:
        plan = make_settings(signals, overrides)
    except IdentificationError as error:
        refusal = str(error)

    def pages(show: "_Show") -> list[Any]:
        return _recording_pages(show, signals, plan, refusal)

    _write(path, signals.robot.name, f"{signals.sha256} {plan}", signals.recording, pages)


def write_comparison_rrd(path: Path, own: Values, other: Values) -> None:
    """Write two sets of parameters as a Rerun file: entities `trust` and `report`. Errors as in `write_fit_rrd`."""
    document = comparison_document(own, other)

    def pages(show: "_Show") -> list[Any]:
        return [
            rrb.Horizontal(
                show(trust_drawing(own, [other])), show(_note(document)), column_shares=[3, 1], name="parameters"
            )
        ]

    name = f"{own.label} and {other.label}"
    _write(path, name, repr((own, other)), name, pages)


def write_study_rrd(path: Path, robot: str, runs: Sequence[Run], document: Document) -> None:
    """Write a study as a Rerun file: entities `study`, every run's error, and `report`, its `document`.

    Errors as in `write_fit_rrd`.
    """

    def pages(show: "_Show") -> list[Any]:
        return [rrb.Horizontal(show(study_drawing(runs)), show(_note(document)), column_shares=[3, 2], name="study")]

    _write(
        path,
        f"{robot} study",
        repr([(run.number, run.error_iv, run.error_ls) for run in runs]),
        f"{robot}, study",
        pages,
    )


_Show = Callable[[Panel], Any]


def _write(path: Path, application: str, told: str, name: str, pages: Callable[[_Show], list[Any]]) -> None:
    named = re.sub(r"[^A-Za-z0-9 _-]+", "-", application)  # Rerun renames an application of another name, and warns
    recording = rr.RecordingStream(f"{named} {hashlib.sha256(told.encode()).hexdigest()[:8]}")
    stream = recording.binary_stream()  # in memory: a failing disk then shows as an OSError where the file is written
    try:
        recording.send_recording_name(name)
        tabs = pages(lambda panel: _show(recording, panel))
        blueprint = rrb.Blueprint(
            rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else tabs[0],
            rrb.TimePanel(state="collapsed", timeline="time", loop_mode="all"),
            collapse_panels=True,
            auto_views=False,
            auto_layout=False,
        )
        recording.send_blueprint(blueprint)
    finally:
        content = stream.read()  # after a failure too: rerun warns of what it drops
        recording.disconnect()
    with whole_file(path) as partial:
        partial.write_bytes(content)


def _fit_pages(show: _Show, signals: Signals, fit: Fit, beside: Fit | None, truth: Vector | None) -> list[Any]:
    """A page with the answer, then pages with the evidence."""
    n, seen = signals.robot.n, observed(signals, fit.settings, fit)
    own = values_of_fit(fit)
    others = [values_of_fit(beside)] if beside else []
    others += [true_values(fit, truth)] if truth is not None else []
    parameters = parameter_drawing(own, others)
    height = parameters.size[1] + 40
    compared = (comparison_section(own, other) for other in others)
    report = _note(fit_document(signals, fit, everything=True).followed_by(*compared, fit_legend(signals, fit)))
    side = rrb.Vertical(show(parameters), show(report), row_shares=[height, max(350.0, 1000.0 - height)])
    curves = (
        [tracking_plot(signals, fit, seen, j, legend=j == 0 or n < 4) for j in range(n)],
        [torque_plot(signals, fit, seen, j, legend=j == 0 or n < 4) for j in range(n)],
    )
    trust = [show(trust_drawing(own, others)), *([show(passes_drawing(fit))] if fit.iv else [])]
    bars = [b for j in range(n) for b in residual_bars(signals, fit, seen, j)]
    columns = min(len(bars) // 2, 3 if n <= 6 else 4)  # a title with its numbers wants a third of a screen
    residual = [rrb.Grid(*map(show, bars[k::2]), grid_columns=columns) for k in (0, 1) if bars]
    return [
        _answer(show, signals, fit, *curves, side),
        rrb.Horizontal(*trust, column_shares=[3, 1][: len(trust)], name="parameters"),
        *([rrb.Vertical(*residual, name="residual")] if residual else []),
        *_signal_pages(show, signals, fit.settings, fitted=True),
        _motion_page(signals, [[show(p) for p in motion_plots(signals, fit, seen, j)] for j in range(n)]),
    ]


def _recording_pages(show: _Show, signals: Signals, plan: Settings | None, refusal: str | None) -> list[Any]:
    n, seen = signals.robot.n, observed(signals, plan, None)
    report = _note(recording_document(signals, plan, refusal).followed_by(recording_legend(signals, plan)))
    curves = (
        [tracking_plot(signals, None, seen, j, legend=j == 0 or n < 4) for j in range(n)],
        [torque_plot(signals, None, seen, j, legend=j == 0 or n < 4) for j in range(n)],
    )
    return [
        _answer(show, signals, None, *curves, show(report)),
        *_signal_pages(show, signals, plan, fitted=False),
        _motion_page(signals, [[show(p) for p in motion_plots(signals, None, seen, j)] for j in range(n)]),
    ]


def _note(document: Document) -> Note:
    return Note(path=("report",), title="report", text=to_markdown(document))


def _answer(
    show: _Show, signals: Signals, fit: Fit | None, tracking: Sequence[Plot], torque: Sequence[Plot], side: Any
) -> Any:
    """The first page: did the robot follow, beside it the robot; is the torque explained; at the side what came out."""
    n = signals.robot.n
    columns = 1 if n == 1 else 2 if n == 2 else 3 if n <= 6 else 4
    follow = rrb.Horizontal(
        rrb.Grid(*map(show, tracking), grid_columns=columns),
        show(robot_scene(signals, fit)),
        column_shares=[2 if n <= 4 else 3, 1],
    )
    explained = rrb.Grid(*map(show, torque), grid_columns=1 if n == 1 else 2 if n == 2 else columns)
    name = "overview" if fit else "recording"
    return rrb.Horizontal(rrb.Vertical(follow, explained, row_shares=[4, 5]), side, column_shares=[5, 2], name=name)


def _signal_pages(show: _Show, signals: Signals, plan: Settings | None, *, fitted: bool) -> list[Any]:
    """How good was the signal: spectra with the cut-offs, phases, the recorder's counters, events; what there is of it."""
    spectra = [show(drawing) for drawing in spectrum_drawings(signals, plan)]
    lanes = span_lanes(signals, plan, fitted=fitted)
    below = [show(panel) for panel in (health_plot(signals), event_log(signals)) if panel is not None]
    rows = [(rrb.Horizontal(*spectra), 5.0)] if spectra else []
    rows += [(show(lanes), 0.6 + 0.4 * len(lanes.lanes))] if lanes else []
    rows += [(rrb.Horizontal(*below), 2.0)] if below else []
    if not rows:
        return []
    views, shares = zip(*rows, strict=True)
    return [rrb.Vertical(*views, row_shares=list(shares), name="signal")]


def _motion_page(signals: Signals, rows: list[list[Any]]) -> Any:
    joints = [rrb.Vertical(*views, name=j.name) for j, views in zip(signals.robot.joints, rows, strict=True)]
    return rrb.Tabs(*joints, name="motion") if len(joints) > 1 else rrb.Vertical(*rows[0], name="motion")


def _show(recording: Any, panel: Panel) -> Any:
    """Write a panel's data as entities under its path; return the view of them."""
    origin = rr.new_entity_path(list(panel.path))

    def log(key: str, what: Any) -> None:
        recording.log(f"{origin}/{key}" if key else origin, what, static=True)

    match panel:
        case Plot():
            for c in panel.curves:
                style = {"names": c.name or c.key, "colors": c.color, "widths": c.width, "visible_series": c.visible}
                key = rr.new_entity_path([c.key]).lstrip("/")
                # Rerun's own rule averages what falls on one pixel, and so loses peaks.
                log(key, rr.SeriesLines(**style, aggregation_policy="MinMax"))
                columns = rr.Scalars.columns(scalars=c.line[1])
                recording.send_columns(f"{origin}/{key}", indexes=[_time(c.line[0])], columns=columns)
            legend = rrb.PlotLegend(corner=_emptiest_corner(panel.curves), visible=panel.legend)
            axis = rrb.TimeAxis(link="LinkToGlobal")
            return rrb.TimeSeriesView(origin=origin, name=panel.title, axis_x=axis, plot_legend=legend)
        case Bars():
            for key, (left, width, heights), color in (("back", panel.back, (*GREY, 120)), ("front", panel.front, RED)):
                log(key, rr.BarChart(heights, abscissa=left, widths=np.full(len(left), width), color=color))
            return rrb.BarChartView(origin=origin, name=panel.title, plot_legend=rrb.PlotLegend(visible=False))
        case Drawing():
            xy, texts, colors = zip(*(((x, y), text, color) for x, y, text, color in panel.labels), strict=True)
            none = rr.Radius.ui_points(0.1)
            log("labels", rr.Points2D(xy, labels=texts, colors=colors, radii=none, show_labels=True))
            strips, colors, radii = zip(*panel.strokes, strict=True)
            log("strokes", rr.LineStrips2D(strips, colors=colors, radii=rr.Radius.ui_points(radii)))
            if panel.dots:
                xy, colors = zip(*(((x, y), color) for x, y, color in panel.dots), strict=True)
                log("dots", rr.Points2D(xy, colors=colors, radii=rr.Radius.ui_points(3.0), draw_order=50.0))
            bounds = rrb.VisualBounds2D(x_range=[0, panel.size[0]], y_range=[0, panel.size[1]])
            return rrb.Spatial2DView(origin=origin, name=panel.title, visual_bounds=bounds)
        case Lanes():
            for name, states in panel.lanes.items():
                key = rr.new_entity_path([name]).lstrip("/")
                changes = [text for _, text, _ in states]
                known = {text: color for _, text, color in states}
                shown = [bool(text) for text in known]
                log(key, rr.StateConfiguration(values=list(known), colors=list(known.values()), visible=shown))
                times = _time(np.array([t_s for t_s, _, _ in states]))
                recording.send_columns(
                    f"{origin}/{key}", indexes=[times], columns=rr.StateChange.columns(state=changes)
                )
            return rrb.StateTimelineView(origin=origin, name=panel.title)
        case Log():
            times = _time(np.array([t_s for t_s, _, _ in panel.lines]))
            levels = ["WARN" if warning else "INFO" for _, warning, _ in panel.lines]
            columns = rr.TextLog.columns(text=[text for _, _, text in panel.lines], level=levels)
            recording.send_columns(origin, indexes=[times], columns=columns)
            columns_shown = rrb.TextLogColumns(timeline_columns=["time"], text_log_columns=["LogLevel", "Body"])
            return rrb.TextLogView(origin=origin, name=panel.title, columns=columns_shown)
        case Note():
            log("", rr.TextDocument(panel.text, media_type="text/markdown"))
            return rrb.TextDocumentView(origin=origin, name=panel.title)
        case Scene():
            return _show_robot(recording, origin, panel)


def _time(t_s: Vector) -> Any:
    return rr.TimeColumn("time", duration=np.rint(1e9 * t_s).astype("timedelta64[ns]"))


def _emptiest_corner(curves: Sequence[Curve]) -> str:
    """Where a legend hides least of the curves."""
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
    """Robots as links with solids fixed to them, or as their URDF draws them, and the poses of their links."""
    for robot in scene.robots:
        path = f"{origin}/{robot.key}"
        times = _time(robot.t_s)
        if scene.urdf is not None:
            tree = _urdf_tree(scene.urdf, origin, robot.key, ghost=robot.ghost)
            tree.log_urdf_to_recording(recording)
            root = f"{robot.key}/{tree.root_link().name.removeprefix(f'{robot.key}/')}"
            fixed = rr.Transform3D(parent_frame=f"tf#{origin}", child_frame=root)
            recording.log(f"{path}/root", fixed, static=True)
            for j, name in enumerate(scene.joints):
                if (joint := tree.get_joint_by_name(name)) is not None:
                    columns = joint.compute_transform_columns(robot.q[:, j].tolist(), clamp=False)
                    recording.send_columns(f"{path}/joints/{j + 1}", indexes=[times], columns=columns)
            continue
        for link in range(robot.places.shape[1] + 1):
            if link > 0:
                columns = rr.Transform3D.columns(
                    translation=robot.places[:, link - 1], quaternion=robot.turns[:, link - 1]
                )
                recording.send_columns(f"{path}/{link}", indexes=[times], columns=columns)
            solids = [s for s in scene.solids if s.link == link and not (robot.ghost and link == 0)]
            for kind in dict.fromkeys(s.kind for s in solids):
                shapes = _shapes(kind, [s for s in solids if s.kind == kind], ghost=robot.ghost)
                recording.log(f"{path}/{link}/{kind}", shapes, static=True)
    grid = rrb.LineGrid3D(plane=rr.components.Plane3D(scene.up, scene.floor), color=(120, 120, 120, 60))
    eye = rrb.EyeControls3D(position=scene.eye, look_target=scene.target, eye_up=scene.up)
    return rrb.Spatial3DView(origin=origin, name=scene.title, line_grid=grid, eye_controls=eye)


def _shapes(kind: str, solids: Sequence[Solid], *, ghost: bool) -> Any:
    colors = [_GHOST if ghost else _SOLID_COLORS[s.part] for s in solids]
    places, turns = [s.center for s in solids], [rr.Quaternion(xyzw=s.turn) for s in solids]
    sizes = np.array([s.size for s in solids]) * (_HALO if ghost else 1.0)
    fill = rr.components.FillMode.Solid
    if kind == "box":
        return rr.Boxes3D(sizes=sizes, centers=places, quaternions=turns, colors=colors, fill_mode=fill)
    length, radius = sizes[:, 0], sizes[:, 1]
    if kind == "cylinder":
        return rr.Cylinders3D(
            lengths=length, radii=radius, centers=places, quaternions=turns, colors=colors, fill_mode=fill
        )
    return rr.Capsules3D(
        lengths=length, radii=radius, translations=places, quaternions=turns, colors=colors, fill_mode=fill
    )


def _urdf_tree(text: str, origin: str, key: str, *, ghost: bool) -> UrdfTree:
    """The tree of a URDF, whose frames are this robot's own; a ghost has one color."""
    root = ET.fromstring(text)
    root.set("name", key)  # its entities are below origin/key: the prefix is one part of a path
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
