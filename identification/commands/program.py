"""`robot-identify`: its commands, each in a file of its own, in the order of the help. A new command is a line here."""

from acquisition.commands import Program
from acquisition.errors import AcquisitionError

from ..errors import IdentificationError

PROGRAM = Program(
    name="robot-identify",
    description="Identify the dynamic parameters of a robot from a recording.",
    package=__package__,
    commands={
        "fit": "base parameters from a recording, or from several",
        "friction": "which friction terms predict parts of a recording, or recordings, held out",
        "fleet": "one fit per recording of folders: a table, and drift over time",
        "view": "look at a recording that has not been fitted, in Rerun",
        "compare": "parameters of two fits side by side",
        "validate": "apply a fit to other recordings",
        "init": "a robot.toml from a URDF, with what is to be filled in marked",
        "export": "a fit as URDF, MJCF or robot.toml, to simulate with",
        "base": "base parameters of a robot, with their expressions",
        "excite": "a reference that tells most of a robot's parameters, within its limits",
        "simulate": "recording of a simulated robot with known parameters",
        "study": "Monte-Carlo on a simulated robot: how far to trust least squares and iv",
        "demo": "simulated drives, a recording, a fit against the truth",
        "schema": "JSON Schema of a robot.toml or of a fit's JSON file",
    },
    errors=(AcquisitionError, IdentificationError),
)
main = PROGRAM.main
