"""Which motion to record and which friction terms to fit: exciting references, friction
terms by cross-validation.
"""

from .excitation import Excitation, ExcitationSettings, excitation_document, excite
from .friction_report import friction_document, friction_file, write_friction
from .information import prior_information
from .selection import select_friction, with_terms
