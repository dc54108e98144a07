"""One report, its renderers: the same numbers in a terminal and in Markdown;
files by their ending.
"""

import math
import re

import pytest

from identification.report import (
    Document,
    Number,
    Section,
    Table,
    columns,
    print_whole,
    to_markdown,
)

VALUES = (1.23456789, -0.000123456, 98765.4321)
FORMS = (".4f", "+.2g", ".1f")
REPORT = Document(
    title="a robot: fit",
    sections=(
        Section(lines=("status: solved",), warnings=("a wrong gain",)),
        Section(
            title="parameters",
            table=Table(
                columns=columns("name", numbers=("|rho|", "b", "c")),
                rows=(
                    ("a|b\\", *(Number(x, form) for x, form in zip(VALUES, FORMS, strict=True))),
                    ("none", Number(None), Number(math.nan), Number(2e9, ".1f", most=1000)),
                ),
                total=True,
            ),
            lines=("x * y < 2 `z`",),
        ),
    ),
)


def markdown_cells(text: str) -> list[list[str]]:
    """The cells of Markdown's tables, read by the rule that a backslash takes a bar's meaning."""
    rows = [
        line for line in text.splitlines() if line.startswith("|") and not line.startswith("|-")
    ]
    cells = [re.split(r"(?<!(?<!\\)\\)\|", row)[1:-1] for row in rows]
    return [[re.sub(r"\\(.)", r"\1", cell.strip()) for cell in row] for row in cells]


def terminal_cells(text: str) -> list[list[str]]:
    return [
        [cell.strip() for cell in line.split("│")[1:-1]]
        for line in text.splitlines()
        if line.startswith("│")
    ]


def test_three_renderers_give_same_cells(capsys):
    print_whole(REPORT)
    terminal, markdown = capsys.readouterr().out, to_markdown(REPORT)
    _, *rows = markdown_cells(markdown)
    assert (
        rows
        == terminal_cells(terminal)
        == [["a|b\\", "1.2346", "-0.00012", "98765.4"], ["none", "-", "-", "> 1000"]]
    )
    for text in (terminal, markdown):
        assert text.index("a robot: fit") < text.index("status: solved") < text.index("parameters")
        assert "Warning: a wrong gain" in text


def test_markdown_escapes_markup():
    text = to_markdown(REPORT)
    assert "| a\\|b\\\\ | 1.2346 |" in text
    assert "| \\|rho\\| |" in text.replace("| name ", "", 1)
    assert "- x \\* y \\< 2 \\`z\\`" in text
    assert next(line for line in text.splitlines() if line.startswith("|--")) == "|---|--:|--:|--:|"


def test_row_has_cell_for_each_column():
    with pytest.raises(ValueError, match="a row of 1 cells in a table of 2 columns"):
        Table(columns=columns("a", "b"), rows=(("x",),))
