"""How Rerun arranges the panels of a page on a screen of 1920 by 1080, and the characters that it can show."""

import unicodedata
from collections.abc import Callable, Sequence
from typing import Any

import rerun.blueprint as rrb

from .panels import Chart, Lanes, Page, Panel

_SIGNS = "–—‘’“”…−√±×²³µ≤≥"  # signs in use here that the viewer's font has
Show = Callable[[Panel], Any]  # writes a panel and returns its view
NOTE_WIDTH = 560.0  # pixels


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
            widths = [max(map(_width, page.groups[key])) * min(3, len(group)) for key, group in views.items()]
            return rrb.Horizontal(*map(_grid, views.values()), column_shares=widths, name=name)


def _width(panel: Panel) -> float:
    return panel.size[0] if isinstance(panel, Chart) else NOTE_WIDTH


def _grid(views: Sequence[Any]) -> Any:
    """Up to three columns; of eight and more views four."""
    return views[0] if len(views) == 1 else rrb.Grid(*views, grid_columns=min(3 if len(views) < 8 else 4, len(views)))
