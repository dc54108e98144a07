"""A report as data, sections of tables and lines, and the base of all JSON files."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from acquisition.files import write_text

FORMAT = 1  # of all JSON files
T = TypeVar("T")
MAX_SHORT_ROWS = 20  # of a table that a terminal prints whole without `--all`


@dataclass(frozen=True)
class Number:
    """A number and its format.

    It is shown as `-` if it is None or not finite, and as `> most` if it is larger than `most`.
    """

    value: float | None
    form: str = "g"
    most: float = math.inf

    @property
    def exact(self) -> float | None:
        """The number itself; None if it is not finite."""
        return None if self.value is None or not math.isfinite(self.value) else self.value

    @property
    def text(self) -> str:
        """The formatted number."""
        return (
            "-"
            if self.exact is None
            else f"> {self.most:g}"
            if abs(self.exact) > self.most
            else format(self.exact, self.form)
        )


Cell = str | Number
Row = tuple[Cell, ...]
# Each column has its heading and a flag: columns of numbers are aligned right.
Columns = tuple[tuple[str, bool], ...]
# a sentence, or a label with one or more lines of its own
Line = str | tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of texts and numbers, one cell per column; with `total` the last row is the total.

    Raises `ValueError` where a row does not have one cell per column.
    """

    columns: Columns
    rows: tuple[Row, ...]
    total: bool = False

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"a row of {len(row)} cells in a table of {len(self.columns)} columns"
                )


@dataclass(frozen=True, kw_only=True)
class Section:
    """A section of a report: a title, a table, lines and warnings; each may be missing.

    `short` is the part that a terminal prints without `--all`; None for all of it. `hint` names
    what `--all` would show; only a terminal prints it.
    """

    title: str = ""
    table: Table | None = None
    lines: tuple[Line, ...] = ()
    warnings: tuple[str, ...] = ()
    hint: str = ""
    short: "Section | None" = None

    def with_short_table(self, order: Sequence[int], most: int = 10) -> "Section":
        """Return the section with a short form of a long table.

        The short form has the `most` rows that come first in `order`.
        """
        if self.table is None or len(self.table.rows) <= MAX_SHORT_ROWS:
            return self
        rows = tuple(self.table.rows[k] for k in sorted(order[:most]))
        return replace(
            self,
            short=replace(
                self,
                table=replace(self.table, rows=rows),
                hint=f"all {len(self.table.rows)} rows",
            ),
        )


@dataclass(frozen=True, kw_only=True)
class Document:
    """A report: a headline and sections in reading order.

    A fit also has its verdict and the count of its tests as `badge`, and figures by their meaning.
    """

    title: str
    sections: tuple[Section, ...]
    badge: str = ""
    figures: tuple[tuple[str, str], ...] = ()

    @property
    def short(self) -> "Document":
        """The part of the report that a terminal prints without `--all`."""
        return replace(self, sections=tuple(section.short or section for section in self.sections))

    def with_short(self, title: str, *lines: Line) -> "Document":
        """Return the report with a short form of a section with this title and these lines."""
        return replace(
            self,
            sections=tuple(
                replace(x, short=Section() if k else Section(title=title, lines=lines))
                for k, x in enumerate(self.sections)
            ),
        )

    def followed_by(self, *sections: Section) -> "Document":
        """Return the report with `sections` appended."""
        return replace(self, sections=(*self.sections, *sections))


def columns(*texts: str, numbers: tuple[str, ...] = ()) -> Columns:
    """Return the columns of a table by their headings: texts, then numbers."""
    return (*((heading, False) for heading in texts), *((heading, True) for heading in numbers))


def value_form(sigma: float) -> str:
    """Return the format of a value with this standard error.

    It has four decimals, or more to show three digits of the standard error.
    """
    return f".{max(4, min(12, 2 - math.floor(math.log10(sigma)))) if sigma > 0 else 4}f"


def cell_text(cell: Cell) -> str:
    """Return the text of a cell."""
    return cell if isinstance(cell, str) else cell.text


def known(value: T | msgspec.UnsetType | None) -> T | None:
    """Return the value of a key; None if the file has none."""
    return None if isinstance(value, msgspec.UnsetType) else value


class ResultFile(msgspec.Struct, frozen=True, kw_only=True):
    """The base of JSON files that are read again, with the version of their format."""

    format: int = FORMAT


def write_json(path: Path, content: ResultFile | Mapping[str, Any]) -> None:
    """Write a result, or its keys, as a JSON file, completely or not at all.

    A number that is not finite becomes null.
    """
    # The standard library cannot write numpy's numbers, so convert them first.
    plain = json.loads(
        msgspec.json.encode(
            content if isinstance(content, ResultFile) else {"format": FORMAT, **content},
            enc_hook=lambda numbers: numbers.tolist(),
        )
    )
    write_text(path, json.dumps(plain, indent=1, ensure_ascii=False) + "\n")
