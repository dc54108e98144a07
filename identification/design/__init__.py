"""Which motion to record and which friction terms to fit: exciting references, friction terms by cross-validation."""

from .excitation import Excitation, ExcitationSettings, excitation_document, excite
from .friction_report import JointFriction, friction_document, friction_file, friction_of_joints, write_friction
from .information import prior_information
from .selection import TermChoice, fits_with, select_friction
from .trials import TermSet, with_terms
