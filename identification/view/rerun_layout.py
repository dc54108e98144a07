"""How Rerun arranges the panels of a page on a screen of 1920 by 1080, and the characters that it can show."""

import unicodedata
from collections.abc import Callable, Sequence
from typing import Any

import rerun.blueprint as rrb

from ..report import cell_text
from .panels import SHEET, Chart, Lanes, Note, Page, Panel

_SIGNS = "–—‘’“”…−√±×²³µ≤≥"  # signs in use here that the viewer's font has
Show = Callable[[Panel], Any]  # writes a panel and returns its view
MIN_NOTE, CELL = 560.0, 8.0  # pixels of a report, and of a character of its tables


def shown_text(text: str) -> str:
    """Text with characters of the viewer's font only: any other character stops the viewer with an error.

    Others are replaced by similar ones (ᵀ by an apostrophe, a wide letter by the plain one), else by a question mark.
    """
    return "".join(c if _has_glyph(c) else _replace_glyph(c) for c in text)


def _has_glyph(c: str) -> bool:
    return c in "\n\t" or " " <= c <= "~" or "¡" <= c <= "ÿ" or ("Α" <= c <= "ω" and c.isalpha()) or c in _SIGNS


def _replace_glyph(c: str) -> str:
    plain = "'" if c == "ᵀ" else "".join(x for x in unicodedata.normalize("NFKD", c) if _has_glyph(x))
    return plain or "?"


def arrange(page: Page, show: Show) -> Any:
    """A container of Rerun with the views of a page."""
    views = {name: [show(panel) for panel in panels] for name, panels in page.groups.items() if panels}
    name, report = shown_text(page.name), views.get("report", [])
    main = {key: value for key, value in views.items() if key != "report"}
    match page.layout:
        case "overview":
            # Tracking and the robot above, torques below, the result at the side.
            n = len(views["torque"])
            columns = 1 if n == 1 else 2 if n == 2 else 3 if n <= 6 else 4
            position = rrb.Grid(*views["position"], grid_columns=columns)
            follow = rrb.Horizontal(position, *views["robot"], column_shares=[2 if n <= 4 else 3, 1])
            both = rrb.Vertical(follow, rrb.Grid(*views["torque"], grid_columns=columns), row_shares=[4, 5])
            heights = [chart.size[1] + 40 for chart in page.groups["parameters"] if isinstance(chart, Chart)]
            shares = [*heights, max(350.0, 1000.0 - sum(heights))]
            side = rrb.Vertical(*views.get("parameters", []), *report, row_shares=shares)
            return rrb.Horizontal(both, side, column_shares=[5, 2], name=name)
        case "signal":
            lanes = next((len(p.lanes) for p in page.groups["session"] if isinstance(p, Lanes)), 0)
            shares_of = {"spectrum": 5.0, "column": 3.0, "session": 0.6 + 0.4 * lanes, "events": 2.0}
            rows = [rrb.Horizontal(*group) for group in main.values()]
            return rrb.Vertical(*rows, row_shares=[shares_of[key] for key in main], name=name)
        case "tabs" if len(main) > 1:
            return rrb.Tabs(*(rrb.Vertical(*group, name=shown_text(key)) for key, group in main.items()), name=name)
        case "rows":
            columns = max(map(len, main.values()))
            return rrb.Vertical(*(rrb.Grid(*group, grid_columns=columns) for group in main.values()), name=name)
        case "excitation":
            joints = [rrb.Vertical(*group) for key, group in main.items() if key.startswith("joint ")]
            left = rrb.Vertical(*views["robot"], rrb.Horizontal(*joints), row_shares=[2, 3])
            side = rrb.Vertical(*views["intervals"], *report, row_shares=[3, 2])
            return rrb.Horizontal(left, side, column_shares=[5, 2], name=name)
        case "drift":
            starts = range(0, len(views["drift"]), 16)
            grids = [rrb.Grid(*views["drift"][k : k + 16], grid_columns=4, name=f"from {k + 1}") for k in starts]
            return rrb.Horizontal(rrb.Tabs(*grids, active_tab=0), *report, column_shares=[5, 2], name=name)
        case _:
            grids = [rrb.Grid(*group, grid_columns=_columns(group)) for group in views.values()]
            widths = [
                min(SHEET[0], max(map(_width, page.groups[key])) * _columns(group)) for key, group in views.items()
            ]
            return rrb.Horizontal(*grids, column_shares=widths, name=name)


def _columns(views: Sequence[Any]) -> int:
    """Of an even grid: pairs side by side."""
    n = len(views)
    return n if n < 4 else 2 if n == 4 else 3 if n < 8 else 4


def _width(panel: Panel) -> float:
    """Pixels of a chart, or of the widest table of a report."""
    if isinstance(panel, Chart):
        return panel.size[0]
    tables = [section.table for section in panel.document.sections if section.table] if isinstance(panel, Note) else []
    rows = [[[head for head, _ in table.columns], *(map(cell_text, row) for row in table.rows)] for table in tables]
    return max(
        [MIN_NOTE, *(CELL * sum(max(map(len, cells)) + 2 for cells in zip(*table, strict=True)) for table in rows)]
    )
