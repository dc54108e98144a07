"""One report of a fit, a recording, a comparison or a study, its renderers, and the JSON files."""

from .comparison import (
    Parameter,
    ParameterSet,
    comparison_document,
    comparison_file,
    comparison_section,
    differences,
    fitted_parameters,
    least_squares_parameters,
    true_parameters,
)
from .document import Cell, Document, Number, ResultFile, Section, Table, columns, document_json, write_json
from .fit_files import fit_file, fit_schema, validation_file
from .fit_report import fit_document, trust_document
from .recording_report import Validated, recording_document, validation_document
from .renderers import check_report_file, print_whole, to_html, to_markdown, write_report
from .stored_fit import StoredFit, doubts, frame_lines, read_fit
from .study_report import base_document, base_file, study_document, study_file, truth_document

__all__ = [
    "Cell",
    "Document",
    "Number",
    "Parameter",
    "ParameterSet",
    "ResultFile",
    "Section",
    "StoredFit",
    "Table",
    "Validated",
    "base_document",
    "base_file",
    "check_report_file",
    "columns",
    "comparison_document",
    "comparison_file",
    "comparison_section",
    "differences",
    "document_json",
    "doubts",
    "fit_document",
    "fit_file",
    "fit_schema",
    "fitted_parameters",
    "frame_lines",
    "least_squares_parameters",
    "print_whole",
    "read_fit",
    "recording_document",
    "study_document",
    "study_file",
    "to_html",
    "to_markdown",
    "true_parameters",
    "trust_document",
    "truth_document",
    "validation_document",
    "validation_file",
    "write_json",
    "write_report",
]
