"""Which friction terms predict a recording: sets of terms, their trials with parts held out, the recommended one."""

from .curves import FrictionCurve, JointFriction, friction_of_joints
from .parts import Part, parts_of
from .report import FrictionFile, friction_document, friction_file, friction_line
from .selection import TermChoice, choose_terms, fits_with, recommended
from .sets import TermSet, described_terms, with_terms
from .trials import Trial, Trials
from .writing import with_friction, write_friction
