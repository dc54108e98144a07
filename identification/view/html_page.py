"""Write a picture as one HTML file without scripts and requests, to be mailed, read on
any screen, and printed.
"""

from dataclasses import replace
from html import escape
from importlib.resources import files
from pathlib import Path

from acquisition.errors import one_line
from acquisition.files import write_text

from ..report import to_html, versions
from .colors import CLASSES
from .panels import Graph, Log, Page, Panel, Picture, Rows
from .svg_panels import HEAD, HEIGHT, PITCH, SHEET, WIDE, draw_graph, draw_rows, width_of

MAX_EVENTS = 100  # of a log
_POLICY = "default-src 'none'; style-src 'unsafe-inline'"


def write_html(path: Path, picture: Picture) -> None:
    """Write the report, all panels but the moving robot, versions and digests as HTML,
    complete or not at all.
    """
    pages = [text for page in picture.pages if (text := _page(page))]
    first = f'<div class="first">{_figure(picture.first)}</div>' if picture.first else ""
    whole = replace(picture.document, title="The whole report", badge="")
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1"><meta '
        'name="color-scheme" content="light dark">',
        f"<title>{escape(one_line(picture.name))}</title><style>{_style()}</style></head><body><main>",
        to_html(picture.document.short, heading=1, figures=first),
        "<details><summary>The whole report: tests, parameters, settings, charts</summary>",
        to_html(whole, heading=1, figures="\n".join(pages)),
        "</details>",
        "<footer><h2>made "
        f"with</h2><p>{', '.join(f'{name} {number}' for name, number in versions().items())}</p>",
        *(
            f"<p>{escape(one_line(name))}: sha256 <code>{code}</code></p>"
            for name, code in picture.sha256.items()
        ),
        "</footer></main></body></html>\n",
    ]
    write_text(path, "\n".join(parts))


def notebook_figure(panel: Panel) -> str:
    """A panel with the style of the report, in a frame, so that the style does
    not change the notebook.
    """
    height = (
        HEIGHT
        if isinstance(panel, Graph)
        else HEAD + PITCH * len(panel.names)
        if isinstance(panel, Rows)
        else 0.0
    )
    content = escape(f"<style>{_style()}</style>{_figure(panel)}")
    size = f"width:100%;max-width:{SHEET:g}px;height:{1.2 * height + 64:g}px"
    return f'<iframe srcdoc="{content}" style="{size};border:0"></iframe>'


def _style() -> str:
    return files(__package__).joinpath("report.css").read_text(encoding="utf-8")


def _page(page: Page) -> str:
    """A page's figures, group by group, two single figures side by side; empty if it has none."""
    rows = list[list[str]]()
    for panels in page.groups.values():
        figures = [figure for panel in panels if (figure := _figure(panel))]
        if rows and len(rows[-1]) == len(figures) == 1:
            rows[-1] += figures
        elif figures:
            rows.append(figures)
    shown = "".join(f'<div class="grid">{"".join(figures)}</div>' for figures in rows)
    return f"<section><h2>{escape(one_line(page.name))}</h2>{shown}</section>" if shown else ""


def _figure(panel: Panel) -> str:
    """A panel with its title and legend; empty for the moving robot."""
    title = escape(one_line(panel.title))
    if isinstance(panel, Log):
        lines = "".join(
            f'<p class="{"warning" if bad else "event"}">{escape(one_line(text))}</p>'
            for _, bad, text in panel.lines[:MAX_EVENTS]
        )
        rest = (
            f"<p>{len(panel.lines) - MAX_EVENTS} more in the recording</p>"
            if len(panel.lines) > MAX_EVENTS
            else ""
        )
        return f'<figure class="wide"><figcaption>{title}</figcaption>{lines}{rest}</figure>'
    if isinstance(panel, Graph):
        named = {c.name or c.key: c for c in panel.curves} if panel.legend else {}
        drawn, keys = (
            draw_graph(panel),
            "".join(
                f'<span class="item"><i class="key {CLASSES[c.color]}'
                f'{" dash" if c.dashed else ""}"></i>{escape(name)}</span> '
                for name, c in named.items()
            ),
        )
    elif isinstance(panel, Rows):
        drawn = draw_rows(panel)
        keys = "".join(
            f'<b class="ink {CLASSES[color]}">{escape(text)}</b>' for text, color in panel.legend
        )
    else:
        return ""
    legend, width = f'<span class="legend">{keys}</span>' if keys else "", width_of(panel)
    kind = "wide" if width == WIDE else "sheet" if width == SHEET else "plot"
    content = f'<figcaption>{title}{legend}</figcaption><div class="scroll">{drawn}</div>'
    return f'<figure class="{kind}" style="--least:{width:.0f}px">{content}</figure>'
