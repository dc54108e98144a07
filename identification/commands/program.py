"""`robot-identify`: one file per command, listed here in the order of the help."""

from acquisition.commands import Program
from acquisition.errors import RobotIdimError

from .arguments import GONE

PROGRAM = Program(
    name="robot-identify",
    description="Identify the dynamic parameters of a robot from a recording.",
    package=__package__,
    commands={
        "fit": "identify base parameters from one or more recordings",
        "friction": "choose friction terms by cross-validation",
        "fleet": "fit all recordings of folders, and mark what has changed",
        "view": "draw a recording in Rerun, before a fit",
        "compare": "compare the parameters of two fits",
        "validate": "torque error of a fit on other recordings",
        "init": "make a robot.toml from a URDF; missing values are marked",
        "export": "export a fit as URDF, MJCF or robot.toml for simulation",
        "base": "base parameters of a robot, with their expressions",
        "excite": "make an exciting trajectory within the limits",
        "simulate": "make a recording of a simulated robot with known parameters",
        "study": "show how far to trust LS and IV, on a robot or a recording",
        "demo": "record simulated drives, fit, compare with the true values",
    },
    gone=GONE,
    errors=(RobotIdimError,),
)
main = PROGRAM.main
