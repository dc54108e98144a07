"""Renders a report as Markdown with tables, for the text panel of a viewer."""

import re

from .document import Document, Section, Table, cell_text


def to_markdown(document: Document) -> str:
    """The report as Markdown; text of the report, such as a robot's name, is never taken for markup."""
    parts = [f"# {_plain(document.title)}", *(part for section in document.sections for part in _section(section))]
    return "\n\n".join(parts) + "\n"


def _section(section: Section) -> list[str]:
    lines = [
        *(f"- **warning: {_plain(text)}**" for text in section.warnings),
        *(f"- {_plain(text)}" for text in section.lines),
    ]
    return [
        *([f"## {_plain(section.title)}"] if section.title else []),
        *([_table(section.table)] if section.table else []),
        *(["\n".join(lines)] if lines else []),
    ]


def _table(table: Table) -> str:
    rows = [
        [column.heading for column in table.columns],
        *([cell_text(cell) for cell in row] for row in table.rows),
    ]
    heading, *body = [f"| {' | '.join(_cell(text) for text in row)} |" for row in rows]
    return "\n".join([heading, f"|{'|'.join('--:' if c.numeric else '---' for c in table.columns)}|", *body])


def _cell(text: str) -> str:
    return _plain(text).replace("|", "\\|")


def _plain(text: str) -> str:
    """Text without markup: on one line, with a backslash before what Markdown would read as more than itself."""
    return re.sub(r"([\\*`<])", r"\\\1", " ".join(text.splitlines()))
