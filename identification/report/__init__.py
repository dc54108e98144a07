"""Documents of sections and tables, their renderers, the JSON files of fits, comparisons.

It owns `Document`, and the types of the files, which are read without the methods. It is the lowest
subpackage and may use none of the others.
"""

from .comparison import (
    Difference,
    ParameterSet,
    comparison_document,
    comparison_section,
    differences,
    frame_lines,
)
from .document import (
    Cell,
    Document,
    Number,
    ResultFile,
    Row,
    Section,
    Table,
    columns,
    known,
    value_form,
    write_json,
)
from .fit_file import (
    NO_FIXED_POINT,
    Ahead,
    Assumed,
    Cause,
    DirectModelResidual,
    FitFile,
    FTest,
    KnownLagFile,
    LagFile,
    Level,
    Method,
    OnRecording,
    PassFile,
    Provenance,
    RecordingOfFit,
    Status,
    TorqueResidual,
    TrustResult,
    ValidationFile,
    Verdict,
    read_fit,
    versions,
)
from .parameters import (
    OF_LINKS,
    PER_INTERVAL,
    ConsistentFile,
    Covariance,
    DriveGain,
    LawFile,
    LeftOut,
    MotorLaw,
    Parameter,
    PayloadOfFit,
    PhysicalWarning,
    StandardParameter,
    base_name,
    by_joint,
    gain_name,
    is_base,
    is_gain,
    is_load,
    is_own,
    meaning_of,
    motor_of,
    own_name,
    payload_name,
    payload_parameter,
    recording_of,
)
from .records import Records
from .renderers import print_whole, to_html, to_markdown
