"""`robot-acquire`: one file per command, listed here in the order of the help."""

from ..errors import RobotIdimError
from .command_line import Program

PROGRAM = Program(
    name="robot-acquire",
    description="Record robots and their drives.",
    package=__package__,
    commands={
        "scan": "find the drives of an unknown bus, by listening and SDO reads only",
        "check": "check which drives answer, and whether they match the description",
        "record": "record drives; nothing moves without --track",
        "mark": "add a note to the recording in progress",
        "disable": "stop and disable all drives, even if another program enabled them; never "
        "refused",
        "emulate": "simulated drives that any CANopen master can use",
        "import": "make a recording from tables, a ROS 2 bag, a CAN log, or the frames of a "
        "recording, which may be cut off",
        "info": "show what a recording contains",
        "export": "export joint samples as CSV",
        "replay": "play the drives' frames and SYNC of a recording onto an idle bus",
    },
    gone={
        "decode": "use import LOG.mcap -o OUT.mcap",
        "recover": "use import CUT.mcap -o OUT.mcap",
        "simulate": "use emulate",
    },
    errors=(RobotIdimError,),
)
main = PROGRAM.main
