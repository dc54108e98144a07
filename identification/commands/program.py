"""`robot-identify`: its commands, each in a file of its own, in the order of the help. A new command is a line here."""

from acquisition.commands import Program
from acquisition.errors import AcquisitionError

from ..errors import IdentificationError
from . import base, compare, demo, excite, export, fit, fleet, friction, init, schema, simulate, study, validate, view

PROGRAM = Program(
    name="robot-identify",
    description="Identify the dynamic parameters of a robot from a recording.",
    commands=(
        *(fit, friction, fleet, view, compare, validate, init, export),
        *(base, excite, simulate, study, demo, schema),
    ),
    errors=(AcquisitionError, IdentificationError),
)
main = PROGRAM.main
