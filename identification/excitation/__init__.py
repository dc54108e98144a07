"""References that tell most of a robot's parameters within its limits, and what is expected of them."""

from .design import Excitation, Settings, excite
from .document import excitation_document
from .knowledge import Knowledge, knowledge_of
