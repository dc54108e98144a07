"""Documents of sections and tables, and their renderers: terminal, Markdown, HTML, JSON."""

from .document import (
    FORMAT,
    Cell,
    Document,
    Number,
    ResultFile,
    Row,
    Section,
    Table,
    columns,
    document_json,
    value_form,
    write_json,
)
from .renderers import check_report_file, print_whole, to_html, to_markdown, write_report
