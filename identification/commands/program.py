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
        "fleet": "fit every recording in folders: a table that marks what has changed",
        "view": "draw a recording in Rerun, before a fit",
        "compare": "compare the parameters of two fits",
        "validate": "torque error of a fit on other recordings",
        "init": "make a robot.toml from a URDF; missing values are marked",
        "export": "export a fit as URDF, MJCF or robot.toml for simulation",
        "base": "base parameters of a robot, with their expressions",
        "excite": "an exciting trajectory that makes the parameters as identifiable as possible "
        "within the limits",
        "simulate": "make a recording of a simulated robot with known parameters",
        "study": "how far to trust least squares and iv: on a simulated robot, or on a recording "
        "with other settings, noise and starts",
        "demo": "record simulated drives, fit, and compare with the true parameters",
    },
    gone=GONE,
    errors=(RobotIdimError,),
)
main = PROGRAM.main
