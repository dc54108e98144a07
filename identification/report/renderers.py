"""Renderers of a report: terminal, Markdown and HTML.

A terminal may have any width. Markdown is for the text panel of a viewer, HTML for notebooks and
pages.
"""

import re
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from html import escape
from io import StringIO

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Column
from rich.table import Table as RichTable
from rich.text import Text

from acquisition.errors import one_line

from .document import Columns, Document, Line, Section, Table, cell_text

_MAX_WORD = 16  # characters; longer words, such as a file's name, are broken
_MAX_WIDTH = 10_000  # characters, for measuring
# White text on these colours has the contrast of 4.5 : 1 that WCAG asks for.
BADGES = {"trust": "#007a59", "caution": "#946200", "do not use": "#b0301c"}
SHORT_WIDTH = 120  # characters of a line of a short report in a pipe


def print_whole(*items: Document | str, short: bool = False, file: StringIO | None = None) -> None:
    """Print reports and lines without truncating cells or interpreting names as markup.

    A table too wide for the terminal is compacted, with headings over several lines; if it is still
    too wide, the terminal breaks its lines. Lines are broken between words; longer words stay
    whole. A pipe or file has the width that COLUMNS gives, by default `SHORT_WIDTH` in `short`, and
    whole lines otherwise. In `short`, the parts that a report hides without `--all` are left out,
    and tables have no frames. The default of `file` is the standard output.
    """
    # In a notebook rich would otherwise show its own output in place of writing to the file.
    console = Console(file=file, force_jupyter=False, markup=False, emoji=False)
    if not console.is_terminal:
        # COLUMNS, if it is a positive number
        console.width = shutil.get_terminal_size((SHORT_WIDTH if short else _MAX_WIDTH, 0)).columns
    for item in items:
        if isinstance(item, str):  # perhaps a command, which has to stay one line
            console.print(Text(one_line(item)), no_wrap=True, overflow="ignore", crop=False)
        else:
            _print_line(console, item.title, "bold")
            for number, section in enumerate(
                x for x in (item.short if short else item).sections if x != Section()
            ):
                # The first section has the verdict, which belongs to the title.
                console.print("\n" * (number > 0), end="")
                _print_section(console, section, framed=not short)


def _print_section(console: Console, section: Section, *, framed: bool) -> None:
    hint = f"(show {section.hint} with --all)" if section.hint else ""
    lines = [*map(_labelled, section.lines), *([("", hint)] if not section.title else [])]
    labels = max((len(label) for label, *_ in lines), default=0)
    margin = " " * (2 * bool(section.title) + labels + 3)
    if section.title:
        _print_line(console, f"{section.title} {hint}", "italic")
    if section.table is not None:
        _print_table(console, _rich_table(section.table, framed=framed))
    for label, *texts in lines:
        for number, text in enumerate(filter(None, texts)):
            name = f"{margin[labels + 3 :]}{label * (number == 0)}"
            own = (name.ljust(len(margin)), margin) if label else ()
            _print_line(console, text, "", *own)
    for warning in section.warnings:
        _print_line(console, f"Warning: {warning}", "yellow")


def _labelled(line: Line) -> tuple[str, ...]:
    """Return the label of a line, empty for none, and its texts."""
    return ("", line) if isinstance(line, str) else line


def _print_line(
    console: Console, text: str, style: str = "", start: str = "", margin: str = "  "
) -> None:
    # Keep a number and its unit together. NUL stands in for the blank, because a line never
    # contains it.
    for line in textwrap.wrap(
        one_line(text).replace(" %", "\0%"),
        console.width,
        initial_indent=start,
        subsequent_indent=margin,
        break_long_words=False,
        break_on_hyphens=False,
    ) or [""]:
        console.print(
            Text(line.replace("\0", " "), style=style), no_wrap=True, overflow="ignore", crop=False
        )


def _rich_table(table: Table, *, framed: bool) -> RichTable:
    drawn = RichTable()
    if not framed:
        _remove_frame(drawn)
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
    Console(
        file=console.file,
        force_jupyter=False,
        markup=False,
        emoji=False,
        width=max(console.width, least),
    ).print(table, crop=False)


def _remove_frame(table: RichTable) -> None:
    table.box, table.padding, table.show_edge = box.SIMPLE_HEAD, (0, 1, 0, 0), False


def _compact(column: Column) -> None:
    """Fold headings of numbers, whose columns keep their width, and texts at words.

    Headings are also folded at hyphens.
    """
    column.overflow = "fold"
    numbers, heading = column.justify == "right", str(column.header)
    cells = [str(cell) for cell in column.cells]
    words = [
        word
        for text in ([re.sub(r"(?<=\w)-(?=\w)", "- ", heading)] if numbers else [heading, *cells])
        for word in text.split()
    ]
    width = min(_MAX_WORD, max((cell_len(word) for word in words), default=1))
    if numbers:
        width = max(width, *(cell_len(cell) for cell in cells), 1)
        column.header = Text("\n".join(textwrap.wrap(heading, width)))
        column.no_wrap, column.max_width = True, width
    column.min_width = width


def to_markdown(document: Document) -> str:
    """Return the report as Markdown, with its text escaped."""
    parts = [f"# {_plain(document.title)}"]
    for section in document.sections:
        parts += [
            f"## {_plain(section.title)}" if section.title else "",
            _markdown_table(section.table) if section.table else "",
            "\n".join(
                [
                    *(f"- **Warning: {_plain(text)}**" for text in section.warnings),
                    *(
                        f"- {f'**{_plain(label)}**: ' * bool(label)}{_plain(' '.join(texts))}"
                        for label, *texts in map(_labelled, section.lines)
                    ),
                ]
            ),
        ]
    return "\n\n".join(filter(None, parts)) + "\n"


def _markdown_table(table: Table) -> str:
    heading, *body = [
        "| " + " | ".join(_plain(cell_text(cell)).replace("|", r"\|") for cell in row) + " |"
        for row in ([heading for heading, _ in table.columns], *table.rows)
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


def to_html(
    document: Document,
    *,
    heading: int = 3,
    figures: Mapping[str, str] | None = None,
    contents: str = "",
) -> str:
    """Return the report as HTML, with its text escaped.

    `figures` are beside the sections with these titles; that of an empty title follows the first
    sections that have no table. If a fit failed, the first section has the cause, and precedes
    `contents`.
    """
    placed = figures or {}
    parts = [
        f'<div class="beside"><section>{part}</section>{placed[section.title]}</div>'
        if section.title and section.title in placed
        else part
        for section in document.sections
        for part in ["\n".join(_html_section(section, heading + 1))]
    ]
    first = next((k for k, section in enumerate(document.sections) if section.table), len(parts))
    causes = min(1, first) if document.badge.startswith("do not use") else 0
    shown = [
        _badge(document.badge),
        *parts[:causes],
        contents,
        _tiles(document.figures),
        *parts[causes:first],
        placed.get("", ""),
        *parts[first:],
    ]
    return "\n".join([_element(f"h{heading}", document.title), *filter(None, shown)])


def _badge(text: str) -> str:
    # A notebook has no style sheet, so that badge and tiles have styles of their own.
    style = "display:inline-block;padding:.2em .8em;border-radius:1em;font-weight:700;color:#fff"
    color = BADGES.get(text.partition(" · ")[0])
    return text and f'<span style="{style};background:{color}">{escape(text)}</span>'


def _tiles(figures: Sequence[tuple[str, str]]) -> str:
    """Return figures side by side, each above its meaning."""
    tiles = (
        '<span style="max-width:13em">'
        f'<b style="display:block;font-size:1.4em">{escape(text)}</b>{escape(what)}</span>'
        for what, text in figures
    )
    style = "display:flex;flex-wrap:wrap;gap:.6em 2em;margin:.6em 0"
    return f'<div style="{style}">{"".join(tiles)}</div>' if figures else ""


def _html_section(section: Section, heading: int) -> list[str]:
    return [
        *([_element(f"h{heading}", section.title)] if section.title else []),
        *([_html_table(section.table)] if section.table else []),
        *(_html_line(*_labelled(line)) for line in section.lines),
        *(_element("p", f"Warning: {text}", ' class="warning"') for text in section.warnings),
    ]


def _html_line(label: str, *texts: str) -> str:
    shown = "".join(_element("span", text, ' style="display:block"') for text in texts)
    return f'<p class="fact"><b>{escape(label)}</b>{shown}</p>' if label else _element("p", *texts)


def _html_table(table: Table) -> str:
    rows = [
        _html_row("th", table.columns, [heading for heading, _ in table.columns]),
        *(_html_row("td", table.columns, [*map(cell_text, row)]) for row in table.rows),
    ]
    return f'<div class="scroll"><table>{"".join(rows)}</table></div>'


def _html_row(tag: str, columns: Columns, texts: Sequence[str]) -> str:
    # Notebooks align cells to the right if they have no style of their own.
    cells = (
        _element(tag, text, ' class="n"' if numeric else ' style="text-align:left"')
        for text, (_, numeric) in zip(texts, columns, strict=True)
    )
    return f"<tr>{''.join(cells)}</tr>\n"


def _element(tag: str, text: str, attributes: str = "") -> str:
    return f"<{tag}{attributes}>{escape(one_line(text))}</{tag}>"
