"""Renders a report: in a terminal of any width, as Markdown for the text panel of a viewer, as HTML
for notebooks and pages.
"""

import os
import re
import textwrap
from collections.abc import Sequence
from html import escape

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Column
from rich.table import Table as RichTable
from rich.text import Text

from acquisition.errors import one_line

from .document import Columns, Document, Section, Table, cell_text

_MAX_WORD = 16  # characters; longer words, such as a file's name, are broken
_MAX_WIDTH = 10_000  # characters, for measuring
# White text on these colours has the contrast of 4.5 : 1 that WCAG asks for.
BADGES = {"trust": "#007a59", "caution": "#946200", "do not use": "#b0301c"}
SHORT_WIDTH = 120  # characters of a line of a short report in a pipe


def print_whole(*items: Document | str, short: bool = False) -> None:
    """Print reports and lines without truncating cells or interpreting names as markup.

    A table too wide for the terminal is compacted, with headings over several lines; if it is still
    too wide, the terminal breaks its lines. A pipe or file gets whole lines. In `short`, the parts
    that a report hides without `--all` are left out, tables have no frames, and also a pipe or file
    gets lines of reports broken between words; longer words stay whole.
    """
    console = Console(markup=False, emoji=False)
    if not console.is_terminal:
        console.width = int(os.environ.get("COLUMNS") or SHORT_WIDTH) if short else _MAX_WIDTH
    for item in items:
        if isinstance(item, str):  # perhaps a command, which has to stay one line
            console.print(Text(one_line(item)), no_wrap=True, overflow="ignore", crop=False)
        else:
            _print_line(console, item.title, "bold")
            for section in item.short.sections if short else item.sections:
                _print_section(console, section, short)


def _print_section(console: Console, section: Section, short: bool) -> None:
    if section.title:
        _print_line(console, section.title, "italic")
    if section.table is not None:
        drawn = _rich_table(section.table)
        if short:
            _remove_frame(drawn)
        _print_table(console, drawn)
    for line in section.lines:
        _print_line(console, line)
    for warning in section.warnings:
        _print_line(console, f"Warning: {warning}", "yellow")
    if section.hint:
        _print_line(console, section.hint, "dim")


def _print_line(console: Console, text: str, style: str = "") -> None:
    # Keep a number and its unit together. NUL stands in for the blank, because a line never
    # contains it.
    for line in textwrap.wrap(
        one_line(text).replace(" %", "\0%"),
        console.width,
        subsequent_indent="  ",
        break_long_words=False,
        break_on_hyphens=False,
    ) or [""]:
        console.print(
            Text(line.replace("\0", " "), style=style), no_wrap=True, overflow="ignore", crop=False
        )


def _rich_table(table: Table) -> RichTable:
    drawn = RichTable()
    for heading, numeric in table.columns:
        drawn.add_column(Text(heading), justify="right" if numeric else "left")
    above_total = len(table.rows) - 1 if table.total else 0
    for number, row in enumerate(table.rows, 1):
        drawn.add_row(*(Text(cell_text(x)) for x in row), end_section=number == above_total)
    return drawn


def _print_table(console: Console, table: RichTable) -> None:
    unbounded = console.options.update(max_width=_MAX_WIDTH)
    if Measurement.get(console, unbounded, table).maximum > console.width:
        _remove_frame(table)
        table.padding = 0
        for column in table.columns:
            _compact(column)
    least = Measurement.get(console, unbounded, table).minimum
    # Rich prints no line wider than its console.
    Console(markup=False, emoji=False, width=max(console.width, least)).print(table, crop=False)


def _remove_frame(table: RichTable) -> None:
    table.box, table.padding, table.show_edge = box.SIMPLE_HEAD, (0, 1, 0, 0), False


def _compact(column: Column) -> None:
    """Fold headings of numbers, whose columns keep their width, and texts at words."""
    column.overflow = "fold"
    numbers, heading = column.justify == "right", str(column.header)
    cells = [str(cell) for cell in column.cells]
    words = [
        word for text in ([heading] if numbers else [heading, *cells]) for word in text.split()
    ]
    width = min(_MAX_WORD, max((cell_len(word) for word in words), default=1))
    if numbers:
        width = max(width, *(cell_len(cell) for cell in cells), 1)
        column.header = Text("\n".join(textwrap.wrap(heading, width, break_on_hyphens=False)))
        column.no_wrap, column.max_width = True, width
    column.min_width = width


def to_markdown(document: Document) -> str:
    """Return the report as Markdown, with its text escaped."""
    parts = [f"# {_plain(document.title)}"]
    for section in document.sections:
        warnings = (f"- **Warning: {_plain(text)}**" for text in section.warnings)
        parts += [
            f"## {_plain(section.title)}" if section.title else "",
            _markdown_table(section.table) if section.table else "",
            "\n".join([*warnings, *(f"- {_plain(text)}" for text in section.lines)]),
        ]
    return "\n\n".join(filter(None, parts)) + "\n"


def _markdown_table(table: Table) -> str:
    rows = [
        [heading for heading, _ in table.columns],
        *([cell_text(cell) for cell in row] for row in table.rows),
    ]
    heading, *body = [
        "| " + " | ".join(_plain(text).replace("|", r"\|") for text in row) + " |" for row in rows
    ]
    return "\n".join(
        [
            heading,
            f"|{'|'.join('--:' if numeric else '---' for _, numeric in table.columns)}|",
            *body,
        ]
    )


def _plain(text: str) -> str:
    """Return text on one line, with Markdown characters escaped."""
    return re.sub(r"([\\*`<])", r"\\\1", " ".join(text.splitlines()))


def to_html(document: Document, *, heading: int = 3, figures: str = "") -> str:
    """Return the report as HTML, with its text escaped.

    `figures` follow the first sections that have no table.
    """
    # The tiles show the figures, so the heading leaves them out.
    title = document.title.split("; ")[0] if document.badge else document.title
    sections = document.sections
    first = next((k for k, section in enumerate(sections) if section.table), len(sections))
    return "\n".join(
        [
            _element(f"h{heading}", title),
            *_tiles(document),
            *(part for section in sections[:first] for part in _html_section(section, heading + 1)),
            *([figures] if figures else []),
            *(part for section in sections[first:] for part in _html_section(section, heading + 1)),
        ]
    )


def _tiles(document: Document) -> list[str]:
    """Return the badge and the figures of a report, with styles of their own since a notebook has
    no style sheet.
    """
    if not document.badge:
        return []
    badge = (
        f"color:#fff;background:{BADGES[document.badge]};padding:.2em "
        ".8em;border-radius:1em;font-weight:700"
    )
    tiles = [
        f'<span style="{badge}">{escape(document.badge)}</span>',
        *(
            "<span><b "
            f'style="display:block;font-size:1.4em">{escape(text)}</b>{escape(what)}</span>'
            for what, text in document.figures
        ),
    ]
    return [
        '<div style="display:flex;flex-wrap:wrap;gap:.6em '
        f'2em;align-items:center">{"".join(tiles)}</div>'
    ]


def _html_section(section: Section, heading: int) -> list[str]:
    return [
        *([_element(f"h{heading}", section.title)] if section.title else []),
        *([_html_table(section.table)] if section.table else []),
        *(_element("p", text) for text in section.lines),
        *(_element("p", f"Warning: {text}", "warning") for text in section.warnings),
    ]


def _html_table(table: Table) -> str:
    head = _html_row("th", table.columns, [heading for heading, _ in table.columns])
    rows = (_html_row("td", table.columns, [*map(cell_text, row)]) for row in table.rows)
    return f'<div class="scroll"><table>{head}{"".join(rows)}</table></div>'


def _html_row(tag: str, columns: Columns, texts: Sequence[str]) -> str:
    cells = (
        _element(tag, text, "n" if numeric else "")
        for text, (_, numeric) in zip(texts, columns, strict=True)
    )
    return f"<tr>{''.join(cells)}</tr>\n"


def _element(tag: str, text: str, kind: str = "") -> str:
    opened = f'<{tag} class="{kind}">' if kind else f"<{tag}>"
    return f"{opened}{escape(one_line(text))}</{tag}>"
