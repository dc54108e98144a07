"""Write a picture as one HTML file without scripts and requests, to be mailed, read on any screen, and printed."""

from html import escape
from pathlib import Path

from acquisition.errors import one_line
from acquisition.files import atomic_write

from ..data import versions
from ..report import to_html
from .panels import GREY, RESIDUAL, Bars, Chart, Color, Log, Page, Panel, Picture, Plot
from .svg_panels import DRAWERS, SHADES

MAX_EVENTS = 100  # of a log
_POLICY = "default-src 'none'; style-src 'unsafe-inline'"


def write_html(path: Path, picture: Picture) -> None:
    """Write the report, all panels but the moving robot, versions and digests as HTML, complete or not at all.

    Raises `AcquisitionError`: the file cannot be written.
    """
    pages = [text for page in picture.pages if (text := _page(page))]
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="light dark">',
        f"<title>{escape(one_line(picture.name))}</title><style>{style_sheet()}</style></head><body><main>",
        to_html(picture.document, heading=1, figures="\n".join(pages)),
        f"<footer><h2>made with</h2><p>{escape(_versions())}</p>",
        *(f"<p>{escape(one_line(name))}: sha256 <code>{code}</code></p>" for name, code in picture.sha256.items()),
        "</footer></main></body></html>\n",
    ]
    with atomic_write(path) as partial:
        partial.write_text("\n".join(parts), encoding="utf-8")


def style_sheet() -> str:
    """The colours of light and dark, and the style of text, tables and figures."""
    light, dark = ("".join(f"--{shade[0]}:{shade[k]};" for shade in SHADES.values()) for k in (1, 2))
    classes = "".join(f".{name}{{--c:var(--{name})}}" for name, _, _ in SHADES.values())
    return (
        f":root{{color-scheme:light dark;--back:#ffffff;--text:#1c1c1c;--line:#d5d5d5;{light}}}"
        f"@media (prefers-color-scheme:dark){{:root{{--back:#121212;--text:#e6e6e6;--line:#3d3d3d;{dark}}}}}"
        f"{classes}{_STYLE}"
    )


_STYLE = """
*{box-sizing:border-box}
body{margin:0;background:var(--back);color:var(--text);font:15px/1.45 system-ui,sans-serif}
main{max-width:1240px;margin:0 auto;padding:16px}
h1{font-size:1.35rem;line-height:1.3}h2{font-size:1.15rem;margin:1.6em 0 .5em}h3{font-size:1rem;margin:1.2em 0 .4em}
h1,h2,h3,p,figcaption,code{overflow-wrap:anywhere}
p{margin:.25em 0}p.warning{color:var(--vermillion)}footer{margin-top:2em;border-top:1px solid var(--line);font-size:.85rem}
.scroll{overflow-x:auto;max-width:100%}
table{border-collapse:collapse;margin:.5em 0;font-size:.88rem}
th,td{padding:2px 10px 2px 0;text-align:left;vertical-align:top;border-bottom:1px solid var(--line)}
.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.grid{display:grid;gap:14px;margin:0 0 18px;align-items:end;grid-template-columns:repeat(auto-fill,minmax(min(100%,var(--column)),1fr))}
figure{margin:0;min-width:0;break-inside:avoid}figure.wide{grid-column:1/-1}
figcaption{font-size:.88rem;font-weight:600}.legend{display:block;font-weight:400;line-height:1.3}.key:first-child{margin-left:0}
svg{display:block;width:100%;height:auto}
.wide svg{min-width:min(var(--least),900px)}
svg text{font:12.5px system-ui,sans-serif}.middle{text-anchor:middle}.end{text-anchor:end}
.l{fill:none;stroke:var(--c);stroke-linejoin:round;vector-effect:non-scaling-stroke}.f{fill:var(--c)}
.soft{opacity:.45}.dash{stroke-dasharray:5 3}.cloud{stroke-width:3;stroke-linecap:round;opacity:.6}
.key{display:inline-block;width:18px;border-top:3px solid var(--c);margin:0 5px 3px 12px}.key.dash{border-top-style:dashed}
@media print{@page{size:A4 landscape;margin:12mm}body{font-size:11px}main{max-width:none;padding:0}
.wide svg{min-width:0}.scroll{overflow:visible}h2,h3{break-after:avoid}tr{break-inside:avoid}}
"""


def _versions() -> str:
    return ", ".join(f"{name} {version}" for name, version in versions().items())


def _page(page: Page) -> str:
    """A page's figures, group by group; empty if it has none."""
    groups = [[figure for panel in panels if (figure := _figure(panel))] for panels in page.groups.values()]
    widths = [panel.size[0] for panels in page.groups.values() for panel in panels if isinstance(panel, Chart)]
    column = f"{min(560, max([360.0, *widths])):.0f}px"
    rows = list[list[str]]()
    for figures in filter(None, groups):
        if rows and len(rows[-1]) == len(figures) == 1:  # two single figures share a row
            rows[-1] += figures
        else:
            rows.append(figures)
    shown = "".join(f'<div class="grid" style="--column:{column}">{"".join(figures)}</div>' for figures in rows)
    return f"<section><h2>{escape(one_line(page.name))}</h2>{shown}</section>" if shown else ""


def _figure(panel: Panel) -> str:
    """A panel with its title and legend; empty for the report and the moving robot."""
    title = escape(one_line(panel.title))
    if isinstance(panel, Log):
        lines = "".join(
            f'<p class="{"warning" if bad else "event"}">{escape(one_line(text))}</p>'
            for _, bad, text in panel.lines[:MAX_EVENTS]
        )
        rest = f"<p>{len(panel.lines) - MAX_EVENTS} more in the recording</p>" if len(panel.lines) > MAX_EVENTS else ""
        return f'<figure class="wide"><figcaption>{title}</figcaption>{lines}{rest}</figure>'
    if type(panel) not in DRAWERS:
        return ""
    drawn, keys = DRAWERS[type(panel)](panel), ""
    if isinstance(panel, Plot) and panel.legend:
        keys = "".join(_key(c.name or c.key, c.color, dashed=c.dashed) for c in panel.curves if c.visible)
    elif isinstance(panel, Bars):
        keys = _key(panel.names[0], RESIDUAL) + _key(panel.names[1], GREY)
    legend = f'<span class="legend">{keys}</span>' if keys else ""
    width = panel.size[0] if isinstance(panel, Chart) else 0.0
    wide = (
        f' class="wide" style="--least:{width:.0f}px"'
        if width > 700 or not isinstance(panel, Chart | Plot | Bars)
        else ""
    )
    return f'<figure{wide}><figcaption>{title}{legend}</figcaption><div class="scroll">{drawn}</div></figure>'


def _key(name: str, color: Color, *, dashed: bool = False) -> str:
    return f'<i class="key {SHADES[color][0]}{" dash" if dashed else ""}"></i>{escape(name)}'
