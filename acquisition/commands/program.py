"""`robot-acquire`: its commands, each in a file of its own, in the order of the help. A new command is listed here."""

from ..errors import AcquisitionError
from . import check, decode, disable, export, import_, info, record, recover, replay, simulate
from .command_line import Program

PROGRAM = Program(
    name="robot-acquire",
    description="Recordings of robots and their drives.",
    commands=(check, record, disable, simulate, import_, info, decode, export, replay, recover),
    errors=(AcquisitionError,),
)
main = PROGRAM.main
