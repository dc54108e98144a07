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
