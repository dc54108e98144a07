"""Prints tables and lines whole, whatever the width of the terminal."""

import textwrap
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Console, Group
from rich.measure import Measurement
from rich.table import Column, Table
from rich.text import Text

from acquisition.errors import one_line

_LONGEST_WORD = 16  # that keeps its column as wide; longer ones, such as a file's name, are broken
_UNBOUNDED = 10_000  # columns, of what is to be measured


def print_whole(*items: Any) -> None:
    """Print tables, groups of them, and lines. No cell is cut short, and no name of a file or robot is taken for markup.

    A table too wide for the terminal is set closer, with headings over several lines; if it is too wide even then, the
    terminal breaks its lines. A pipe or file gets whole lines, however long.
    """
    console = Console(markup=False, emoji=False)
    if not console.is_terminal:
        console.width = _UNBOUNDED
    for item in items:
        for part in item.renderables if isinstance(item, Group) else (item,):
            if isinstance(part, Table):
                _print_table(console, part)
            else:
                console.print(Text(one_line(part)) if isinstance(part, str) else part)


def _print_table(console: Console, table: Table) -> None:
    unbounded = console.options.update(max_width=_UNBOUNDED)
    if Measurement.get(console, unbounded, table).maximum > console.width:
        table.box, table.padding, table.show_edge = box.SIMPLE_HEAD, (0, 1, 0, 0), False
        for column in table.columns:
            _set_close(column)
    least = Measurement.get(console, unbounded, table).minimum
    # Rich prints nothing wider than its console.
    Console(markup=False, emoji=False, width=max(console.width, least)).print(table, crop=False)


def _set_close(column: Column) -> None:
    """Numbers as wide as they are, their heading above them on as many lines as it takes; texts may be folded at words."""
    column.overflow = "fold"
    numbers, heading = column.justify == "right", str(column.header)
    cells = [str(cell) for cell in column.cells]
    words = [word for text in ([heading] if numbers else [heading, *cells]) for word in text.split()]
    width = min(_LONGEST_WORD, max((cell_len(word) for word in words), default=1))
    if numbers:
        width = max(width, *(cell_len(cell) for cell in cells), 1)
        column.header = Text("\n".join(textwrap.wrap(heading, width, break_on_hyphens=False)))
        column.no_wrap, column.max_width = True, width
    column.min_width = width
