"""One report of a fit, a recording, a comparison or a study, and its renderers; the JSON files."""

from .comparison import (
    Difference,
    Value,
    Values,
    comparison_document,
    comparison_section,
    differences,
    frame_lines,
    true_values,
    values_of_fit,
    values_of_stored,
)
from .document import Cell, Document, Number, Section, Table, columns
from .fit_file import (
    StoredFit,
    base_json,
    doubts,
    errors_json,
    fit_json,
    plan_json,
    provenance,
    read_fit,
    truth_json,
    write_json,
)
from .fit_report import fit_document
from .markdown import to_markdown
from .recording_report import recording_document, validation_document
from .study_report import base_document, study_document, truth_document
from .terminal import print_whole

__all__ = [
    "Cell",
    "Difference",
    "Document",
    "Number",
    "Section",
    "StoredFit",
    "Table",
    "Value",
    "Values",
    "base_document",
    "base_json",
    "columns",
    "comparison_document",
    "comparison_section",
    "differences",
    "doubts",
    "errors_json",
    "fit_document",
    "fit_json",
    "frame_lines",
    "plan_json",
    "print_whole",
    "provenance",
    "read_fit",
    "recording_document",
    "study_document",
    "to_markdown",
    "true_values",
    "truth_document",
    "truth_json",
    "validation_document",
    "values_of_fit",
    "values_of_stored",
    "write_json",
]
