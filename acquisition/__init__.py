"""Recording of joint positions and current references of industrial drives into MCAP files.

The subpackages, lowest first. Each one imports only lower ones, and only what their `__init__`
exports::

    files        atomic writing, columns of tables, meshes of a URDF, large arrays on disk
    protocol     CANopen (CiA 301) and CiA 402 without I/O: states, objects, SDO, PDO,
                 object dictionaries
    robot        the description (robot.toml): joints, motors, limits, bus and drives;
                 references and their limits
    recording    the MCAP format, frames decoded to samples at SYNC, ROS messages
    bus          frames and times of a bus; the CANopen master: listening, requests, heartbeat,
                 stop of all drives
    simulated    simulated drives, the plants that they move, dry runs
    session      the loop that sends: record, enable, track, stop; guards; the process of the
                 recorder with the watchdog
    importing    recordings from tables, ROS 2 bags, CAN logs and EtherCAT captures; export
    commands     the command line

The names that are used most are imported at their first use:

>>> import acquisition
>>> samples = acquisition.read_recording("log.mcap").samples
"""

from typing import TYPE_CHECKING

from .lazy import lazy_names

if TYPE_CHECKING:
    from .errors import (
        BadInputError,
        BusFaultError,
        NoAnswerError,
        RefusedError,
        RobotIdimError,
        SdoAbortedError,
    )
    from .recording import Recording, read_recording
    from .robot import Robot, load_robot

__all__ = [
    "BadInputError",
    "BusFaultError",
    "NoAnswerError",
    "Recording",
    "RefusedError",
    "Robot",
    "RobotIdimError",
    "SdoAbortedError",
    "load_robot",
    "read_recording",
]

if not TYPE_CHECKING:  # a type checker would accept any name
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "errors": tuple(name for name in __all__ if name.endswith("Error")),
            "recording": ("Recording", "read_recording"),
            "robot": ("Robot", "load_robot"),
        },
    )
