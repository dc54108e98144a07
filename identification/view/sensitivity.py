"""Charts of how the estimates of one recording depend on filter, decimation, position noise and start."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..report import Document
from ..study import VariedFit
from .panels import GREY, LIGHT, ORANGE, PURPLE, Chart, Note, Page, Picture, Scale

CHARTS_OF_PAGE = 6


def draw_sensitivity(signals: Mapping[str, str], fits: Sequence[VariedFit], document: Document) -> Picture:
    """A chart per essential parameter: entities `sensitivity/<parameter>` and `report`; `signals`: sha256 by recording."""
    charts = [sensitivity_drawing(fits, name) for name in fits[0].essential or fits[0].values]
    starts, name = range(0, len(charts), CHARTS_OF_PAGE), ", ".join(signals)
    note = Note(path=("report",), title="report", document=document)
    pages = [
        Page(name=f"sensitivity from {k + 1}", groups={"charts": charts[k : k + CHARTS_OF_PAGE], "report": [note]})
        for k in starts
    ]
    return Picture(name=f"{name}, sensitivity", document=document, pages=tuple(pages), sha256=dict(signals))


def sensitivity_drawing(fits: Sequence[VariedFit], name: str) -> Chart:
    """A parameter in all variants by both methods with 95 % intervals; grey lines at that of IV by the rules."""
    title = f"{name} ± 95 %: × purple LS, orange IV; grey lines: interval of IV by the rules"
    chart = Chart(path=("sensitivity", name), title=title, size=(720.0, 420.0))
    values = np.array([fit.values.get(name, (np.nan,) * 4) for fit in fits])  # (fits, 4)
    middle, half = values[:, [0, 2]], values[:, [1, 3]]
    low, high = float(np.nanmin(middle - half)), float(np.nanmax(middle + half))
    up, across = Scale(left=340, right=20, low=low, high=high), Scale(left=90, right=710, low=0, high=len(fits))
    _, _, iv, of_iv = values[0].tolist()
    chart.ticks_up(up, {x: f"{x:.4g}" for x in (low, high)}, (85, 710), 42)
    for edge in (iv - of_iv, iv + of_iv):
        chart.line(85, up(edge), 710, up(edge))
    changed = [fit.variant.changed for fit in fits]
    for kind in dict.fromkeys(changed[1:]):
        first, count = changed.index(kind), changed.count(kind)
        chart.line(across(first), 20, across(first), 380)
        chart.label(across(first + 0.5 * count), 395, kind, LIGHT)
    for k, (fit, row) in enumerate(zip(fits, values.tolist(), strict=True)):
        chart.label(across(k + 0.5), 350 + 22 * (k % 2), fit.variant.to.split(" ")[-1 if not k else 0], GREY)
        for place, value, size, color, ends in (
            (k + 0.38, *row[:2], PURPLE, chart.crosses),
            (k + 0.62, *row[2:], ORANGE, chart.dots),
        ):
            if np.isfinite(value):
                chart.line(across(place), up(value - size), across(place), up(value + size), color, 1.0)
                ends.append((across(place), up(value), color))
    return chart
