"""`robot-acquire`: one file per command, listed here in the order of the help."""

from ..errors import AcquisitionError
from .command_line import Program

PROGRAM = Program(
    name="robot-acquire",
    description="Record robots and their drives.",
    package=__package__,
    commands={
        "scan": "find the drives of an unknown bus, by listening and SDO reads only",
        "check": "check which drives answer, and whether they match the description",
        "record": "record drives; nothing moves without --track",
        "mark": "note a text in a recording while another terminal records it",
        "disable": "stop and disable all drives, even if another program enabled them; never refused",
        "emulate": "simulated drives that any CANopen master can use",
        "import": "make a recording from tables (CSV, MAT), a ROS 2 bag or a CAN log (candump, ASC, BLF, TRC)",
        "info": "show what a recording contains",
        "decode": "decode a recording's CAN frames into joint samples again",
        "export": "export joint samples as CSV or as a ROS 2 bag",
        "replay": "play the drives' frames and SYNC of a recording onto an idle bus",
        "recover": "repair a recording that was cut off",
    },
    gone={"simulate": "use emulate"},
    errors=(AcquisitionError,),
)
main = PROGRAM.main
