"""`robot-acquire`: its commands, each in a file of its own, in the order of the help. A new command is a line here."""

from ..errors import AcquisitionError
from .command_line import Program

PROGRAM = Program(
    name="robot-acquire",
    description="Recordings of robots and their drives.",
    package=__package__,
    commands={
        "check": "who answers on the bus, and whether it is as described",
        "record": "record drives; nothing moves without --track",
        "disable": "stop and disable all drives, whoever enabled them; never refused",
        "simulate": "simulated drives on the bus of a description, for anyone's master",
        "import": "tables (CSV, MAT), ROS 2 bags or CAN logs (candump, ASC, BLF, TRC) into a recording",
        "info": "what a recording holds",
        "decode": "a recording's CAN frames into joint samples again",
        "export": "joint samples as CSV, or as a ROS 2 bag",
        "replay": "what a recording's drives sent, and SYNC, on a silent bus",
        "recover": "a whole recording from one that was cut",
    },
    errors=(AcquisitionError,),
)
main = PROGRAM.main
