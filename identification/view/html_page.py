"""Renderer of a result as one HTML file without scripts and requests.

The file can be mailed, read on any screen, and printed. Panels are SVG: curves reduced to the
pixels of a page, colours as classes that a style sheet sets for light and dark.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np

from acquisition.errors import one_line
from acquisition.files import write_text

from ..arrays import Array
from ..report import to_html, versions
from .curves import extremes
from .panels import (
    CLASSES,
    GREY,
    LIGHT,
    Axis,
    Color,
    Curve,
    Graph,
    Line,
    Log,
    Mark,
    Page,
    Panel,
    Picture,
    Plot,
    Rows,
    decades,
    linear,
    logarithmic,
)

MAX_EVENTS = 100  # of a log
_CONTENTS = "<nav></nav>"  # filled when the headings are known
_POLICY = "default-src 'none'; style-src 'unsafe-inline'"
WIDTH = 480.0  # of a plot, in pixels
LEFT, RIGHT, TOP = 56.0, 472.0, 8.0  # edges of its axes
EDGES = ((178.0, TOP), (268.0, 192.0))  # lower and upper ones, also of axes below the first
FOOT = 38.0  # height of the texts below
SHEET, WIDE = 560.0, 1180.0  # widths of rows with two or three columns, and with more
KINDS = {WIDTH: "plot", SHEET: "sheet", WIDE: "wide"}  # in the style sheet
HEAD, PITCH = 36.0, 18.0  # heights of the heads of rows, and of a row
_RING = "m-3.2 0a3.2 3.2 0 1 0 6.4 0a3.2 3.2 0 1 0-6.4 0"
# the axis across, the upright one, and its lower and upper edges
Axes = tuple[Axis, Axis, tuple[float, float]]
STEPS = 2.0  # coordinates of curves are whole numbers, this many in a pixel


def write_html(path: Path, picture: Picture) -> None:
    """Write the report, all panels but the moving robot, versions and digests as HTML.

    The short report comes first. The whole one follows folded, if it has more. The file is written
    completely or not at all.
    """
    shown = set[Curve | Panel]()
    front = (
        _figure(picture.first)
        if picture.first and not picture.front
        else _page(picture.front or picture.pages[0], shown)
    )
    others = "".join(_page(page, shown) for page in picture.pages)
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1"><meta '
        'name="color-scheme" content="light dark">',
        f"<title>{escape(one_line(picture.name))}</title><style>{_style()}</style></head><body><main>",
        to_html(
            picture.document.short,
            heading=1,
            figures={
                "": f'<div class="first">{front}</div>',
                **{title: _figure(panel) for title, panel in picture.beside.items()},
            },
            contents=_CONTENTS,
        ),
        *(
            (
                "<details><summary>The whole report: tests, parameters, settings, charts</summary>",
                to_html(
                    replace(picture.document, title="The whole report", badge="", figures=()),
                    heading=1,
                    figures={"": others},
                ),
                "</details>",
            )
            if others or picture.document.short != picture.document
            else ()
        ),
        '<footer><h2 class="made">Made with</h2>'
        f"<p>{', '.join(f'{name} {number}' for name, number in versions().items())}</p>",
        *(
            f"<p>{escape(one_line(name))}: SHA-256 <code>{code}</code></p>"
            for name, code in picture.sha256.items()
        ),
        "</footer></main></body></html>\n",
    ]
    write_text(path, _with_contents("\n".join(parts)))


def _with_contents(text: str) -> str:
    """Number the headings of a page, and link each text of them in its contents once."""
    start, *pieces = text.split("<h2>")
    names = [piece.partition("</h2>")[0].partition(". ")[0] for piece in pieces]
    links = "".join(
        f'<a href="#s{k}">{name}</a>' * (name not in names[:k])
        + "<span>In the whole report:</span>" * ("<details>" in pieces[k])
        for k, name in enumerate(names)
    )
    numbered = start + "".join(f'<h2 id="s{k}">{piece}' for k, piece in enumerate(pieces))
    return numbered.replace(_CONTENTS, f'<nav aria-label="Contents">{links}</nav>')


class Figures(str):
    """Figures as HTML, which a notebook shows."""

    _repr_html_ = str.__str__

    def __repr__(self) -> str:
        count = self.count("&lt;/figure&gt;")
        return (
            f"{count} figure{'s' * (count != 1)}, for a notebook. Without a notebook: "
            'fit.write_report("report.html")'
        )

    __str__ = __repr__


def notebook_figures(*panels: Panel) -> Figures:
    """Return panels below each other, with the style of the report.

    They are in a frame that keeps the style from the notebook.
    """
    heights = [
        EDGES[-1][0] + FOOT
        if isinstance(panel, Graph)
        else HEAD + PITCH * len(panel.names)
        if isinstance(panel, Rows)
        else 0.0
        for panel in panels
    ]
    content = escape(f"<style>{_style()}</style>{''.join(map(_figure, panels))}")
    return Figures(
        f'<iframe srcdoc="{content}" style="width:100%;max-width:{SHEET:g}px;'
        f'height:{sum(1.2 * height + 64 for height in heights):g}px;border:0"></iframe>'
    )


def _style() -> str:
    return files(__package__).joinpath("report.css").read_text(encoding="utf-8")


def _page(page: Page, shown: set[Curve | Panel]) -> str:
    """Return a view's figures, group by group, two single figures side by side.

    Figures of curves that are `shown` are left out, and those of others are added to it. The text
    is empty if the view has no figures.
    """
    rows = list[list[str]]()
    for panels in page.groups.values():
        new = [panel for panel in panels if not _content(panel) <= shown]
        figures = [figure for panel in new if (figure := _figure(panel))]
        shown.update(*map(_content, new))
        if rows and len(rows[-1]) == len(figures) == 1:
            rows[-1] += figures
        elif figures:
            rows.append(figures)
    grids = "".join(f'<div class="grid">{"".join(figures)}</div>' for figures in rows)
    return f"<section><h2>{escape(one_line(page.name))}</h2>{grids}</section>" if grids else ""


def _content(panel: Panel) -> set[Curve | Panel]:
    return {*(panel.curves if isinstance(panel, Graph) else ())} or {panel}


def _figure(panel: Panel) -> str:
    """Return a panel with its title and legend; empty for the moving robot."""
    title = escape(one_line(panel.title))
    match panel:
        case Log():
            lines = (
                *(
                    f'<p class="{"warning" if bad else "event"}">{escape(one_line(text))}</p>'
                    for _, bad, text in panel.lines[:MAX_EVENTS]
                ),
                f"<p>{len(panel.lines) - MAX_EVENTS} more in the recording</p>"
                * (len(panel.lines) > MAX_EVENTS),
            )
            return f'<figure class="wide"><figcaption>{title}</figcaption>{"".join(lines)}</figure>'
        case Graph():
            named = {c.name or c.key: c for c in panel.curves} if panel.legend else {}
            drawn = draw_graph(panel)
            keys = "".join(
                f'<span class="item"><i class="key {CLASSES[c.color]}'
                f'{" dash" if c.dashed else ""}"></i>{escape(name)}</span> '
                for name, c in named.items()
            )
        case Rows():
            drawn = draw_rows(panel)
            keys = "".join(
                f'<b class="ink {CLASSES[color]}">{escape(text)}</b>'
                for text, color in panel.legend
            )
        case _:
            return ""
    legend, width = f'<span class="legend">{keys}</span>' if keys else "", width_of(panel)
    return (
        f'<figure class="{KINDS[width]}" style="--least:{width:.0f}px"><figcaption>{title}{legend}'
        f'</figcaption><div class="scroll">{drawn}</div></figure>'
    )


def draw_graph(graph: Graph) -> str:
    """Draw curves with their axes; those `below` the others have axes of their own."""
    curves = sorted(
        (curve for curve in graph.curves if np.isfinite(curve.line[1]).any()),
        key=lambda curve: curve.key,
    )
    t, _ = _known(curves, graph.dots)
    across = (logarithmic if graph.log else linear)(t.min(), t.max(), 6)
    bands = [band for below in (False, True) if (band := [c for c in curves if c.below == below])]
    bottom, parts = EDGES[len(bands[1:])][0], list[str]()
    for band, edges in zip(bands or [[]], EDGES, strict=False):
        axes = across, _up(graph, band), edges
        parts += [
            *_grid(axes),
            *(_cloud(xy, color, axes) for xy, color in graph.dots),
            f'<g transform="scale({1 / STEPS:g})">',
            *(_curve(curve, axes) for curve in band),
            "</g>",
        ]
    for number, mark in enumerate(mark for mark in graph.marks if t.min() < mark < t.max()):
        at = float(across.place(mark, LEFT, RIGHT))
        parts += [
            f'<path class="l grey" stroke-width="1.5" d="M{_n(at)} {TOP:g}V{bottom:g}"/>',
            _text(at - 4, bottom - 24 + 16 * number, graph.marks[mark], GREY, "end"),
        ]
    label = "time [s]" if isinstance(graph, Plot) else graph.title.rpartition(" over ")[2]
    parts += [
        *(
            _text(min(x, RIGHT - 4 * len(text)), bottom + 16, text, GREY)
            for value, text in across.ticks.items()
            for x in [float(across.place(value, LEFT, RIGHT))]
        ),
        _text(0.5 * (LEFT + RIGHT), bottom + 32, label, GREY),
    ]
    return _svg(graph.title, WIDTH, bottom + FOOT, parts)


def _known(curves: Sequence[Curve], dots: Sequence[tuple[Array, Color]]) -> Array:
    """Return the finite points (2, k) of curves and dots; a zero if there are none."""
    points = np.concatenate(
        [*(np.stack(c.line, axis=1) for c in curves), *(xy for xy, _ in dots), np.zeros((0, 2))]
    )
    known = points[np.isfinite(points).all(axis=1)]
    return (known if len(known) else np.zeros((1, 2))).T  # of a joint that stands still


def _up(graph: Graph, curves: Sequence[Curve]) -> Axis:
    """Return the upright axis of some curves of a graph."""
    _, x = _known(curves, graph.dots)
    margin = 0.04 * float(np.ptp(x)) or 0.05 * float(np.abs(x).max()) or 1.0
    return (
        decades([max(x.min(), 1e-12 * x.max()), x.max()], 6)
        if graph.log
        else linear(x.min() - margin, x.max() + margin, 5)
    )


def draw_rows(rows: Rows) -> str:
    """Draw values by row: names at the left, then the columns with their heads, ticks and lines."""
    width, count = width_of(rows), len(rows.names)
    left, bottom = 20 + 7.0 * max(len(name) for name, _ in rows.names), HEAD + PITCH * count
    bands = [f"M0 {HEAD + PITCH * row:g}H{width:g}v{PITCH:g}H0z" for row in range(0, count, 2)]
    parts = [
        f'<path class="band" d="{"".join(bands)}"/>',
        *(
            _text(4, HEAD + PITCH * row + 13, name, color, "start")
            for row, (name, color) in enumerate(rows.names)
        ),
    ]
    step = (width - left) / len(rows.columns)
    for number, column in enumerate(rows.columns):
        edges = left + step * number + 16, left + step * (number + 1) - 18
        parts += [
            _text(0.5 * sum(edges), 13, column.head, LIGHT),
            *(
                '<path class="l soft grey" '
                f'stroke-width="{1.5 if value in column.lines else 0.6:g}" '
                f'd="M{_n(float(column.axis.place(value, *edges)))} {HEAD:g}V{bottom:g}"/>'
                for value in [*column.axis.ticks, *column.lines]
            ),
            *(
                _text(float(column.axis.place(value, *edges)), HEAD - 5, text, GREY)
                for value, text in column.axis.ticks.items()
            ),
            *(_mark(mark, column.axis, edges) for mark in column.marks),
        ]
    return _svg(rows.title, width, bottom + 4, parts)


def width_of(panel: Panel) -> float:
    """Return the width of a chart in pixels."""
    return (
        {1: WIDTH, 2: SHEET, 3: SHEET}.get(len(panel.columns), WIDE)
        if isinstance(panel, Rows)
        else WIDTH
    )


def _mark(mark: Mark, axis: Axis, edges: tuple[float, float]) -> str:
    """Draw a value's shape and interval."""
    y = HEAD + PITCH * (mark.row + 0.5)
    low, x, high = axis.place(
        [mark.value - mark.half, mark.value, mark.value + mark.half], *edges
    ).tolist()
    color, zero = CLASSES[mark.color], float(axis.place(max(axis.low, 0.0), *edges))
    if mark.shape == "bar":
        seen = math.copysign(max(1.5, abs(x - zero)), x - zero)
        return f'<path class="l {color}" stroke-width="4" d="M{_n(zero)} {_n(y)}h{_n(seen)}"/>'
    kind, shape = {
        "dot": ("f", _RING), "ring": ("l", _RING), "cross": ("l", "m-4-4l8 8m0-8l-8 8"),
        "tick": ("l", "m0-8v16")
    }[mark.shape]  # fmt: skip
    drawn = f'<path class="{kind} {color}" stroke-width="1.6" d="M{_n(x)} {_n(y)}{shape}"/>'
    interval = f'<path class="l {color}" stroke-width="2.2" d="M{_n(low)} {_n(y)}H{_n(high)}"/>'
    return interval + drawn if high - low > 2 else drawn


def _svg(title: str, width: float, height: float, parts: Iterable[str]) -> str:
    return (
        f'<svg role="img" aria-label="{escape(title)}" viewBox="0 0 {width:g} {height:g}" '
        f'style="max-width:{1.35 * width if width < SHEET else width:.0f}px">{"".join(parts)}</svg>'
    )


def _grid(axes: Axes) -> list[str]:
    """Draw lines at all ticks, and the texts of the upright axis."""
    across, up, (bottom, top) = axes
    ups = [(float(up.place(value, bottom, top)), text) for value, text in up.ticks.items()]
    lines = [
        *(f"M{LEFT:g} {_n(y)}H{RIGHT:g}" for y, _ in ups),
        *(f"M{_n(float(across.place(x, LEFT, RIGHT)))} {top:g}V{bottom:g}" for x in across.ticks),
    ]
    return [
        f'<path class="l soft grey" stroke-width="0.6" d="{"".join(lines)}"/>',
        *(_text(LEFT - 6, y + 4, text, GREY, "end") for y, text in ups),
    ]


def _places(axes: Axes, xy: Line | Array) -> Line:
    """Return points in pixels."""
    across, up, edges = axes
    return across.place(xy[0], LEFT, RIGHT), up.place(xy[1], *edges)


def _cloud(xy: Array, color: Color, axes: Axes) -> str:
    """Draw dots (k, 2)."""
    path = "".join(f"M{_n(x)} {_n(y)}h0" for x, y in zip(*_places(axes, xy.T), strict=True))
    return f'<path class="l cloud {CLASSES[color]}" d="{path}"/>'


def _curve(curve: Curve, axes: Axes) -> str:
    """Draw a curve by its minimum and maximum in each column of pixels."""
    known = np.isfinite(curve.line[1])
    x, y = _places(axes, (curve.line[0][known], curve.line[1][known]))
    k = extremes(y, max(1, math.ceil(len(y) / max(1.0, float(np.ptp(x))))))
    xy = np.rint(STEPS * np.stack([x[k], y[k]], axis=1)).astype(int)
    steps = " ".join(f"{dx} {dy}" for dx, dy in np.diff(xy, axis=0).tolist() if dx or dy)
    # A curve of one moment has no length, so draw a point that can be seen.
    path = f"M{xy[0, 0]} {xy[0, 1]}l{steps.replace(' -', '-') or f'{STEPS:g} 0'}"
    look = f"l {CLASSES[curve.color]}{' dash' if curve.dashed else ''}"
    return f'<path class="{look}" stroke-width="{max(1.2, 1.1 * curve.width):g}" d="{path}"/>'


def _text(x: float, y: float, text: str, color: Color, anchor: str = "middle") -> str:
    return (
        f'<text class="f {CLASSES[color]} {anchor}" x="{_n(x)}" y="{_n(y)}">{escape(text)}</text>'
    )


def _n(x: float) -> str:
    """Return a coordinate with one decimal at most."""
    return f"{x:.1f}".removesuffix(".0")
