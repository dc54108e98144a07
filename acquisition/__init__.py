"""Records joint positions and current references of industrial drives into MCAP files.

The rooms, ground floor first. Each is entered by its face, what its `__init__` shows; imports only run down::

    files        files written whole or not at all, columns of tables, meshes of a URDF
    protocol     CANopen (CiA 301) and CiA 402 without I/O: states, objects, SDO, PDO, object dictionaries
    robot        the description (robot.toml): joints, motors, limits, bus and drives; references, checked against the limits
    recording    the MCAP format, frames decoded to rows on the grid of SYNC, ROS messages
    bus          frames and times of a bus; the CANopen master: listening, requests, heartbeat, the one stop of all drives
    simulated    simulated drives, the plants they move, dry runs
    session      the one loop that sends: record, enable, track, stop; its guards; the recorder's process, the second stop
    importing    recordings out of tables, ROS 2 bags and CAN logs; export
    commands     the command line

From Python, what is used most is here under one name, imported when it is first used::

    import acquisition

    samples = acquisition.read_recording("log.mcap").samples
"""

from typing import TYPE_CHECKING

from .lazy import lazy_names

if TYPE_CHECKING:
    from .errors import AcquisitionError
    from .recording import Recording, read_recording
    from .robot import Robot, load_robot

__all__ = ["AcquisitionError", "Recording", "Robot", "load_robot", "read_recording"]

if not TYPE_CHECKING:  # a type checker would take any name
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "errors": ("AcquisitionError",),
            "recording": ("Recording", "read_recording"),
            "robot": ("Robot", "load_robot"),
        },
    )
