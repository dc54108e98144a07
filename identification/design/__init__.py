"""Which motion to record and which friction terms to fit: exciting references, terms chosen with parts held out."""

from .curves import JointFriction, friction_of_joints
from .design import Excitation, Settings, excite
from .document import excitation_document
from .knowledge import knowledge_of
from .parts import parts_of
from .report import friction_document, friction_file
from .selection import choose_terms, fits_with
from .sets import TermSet, with_terms
from .trials import Trials
from .writing import with_friction, write_friction
