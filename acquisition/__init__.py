"""Records joint positions and current references of industrial drives into MCAP files.

The flow::

    robot.toml ──robot──> Robot ──┐
    tables (CSV, MAT) ──tables────┴──> recording.mcap (raw data, robot description, health)

``robot`` says what the robot is, ``recording`` owns the file format, ``tables`` imports recordings made elsewhere,
``whole_file`` keeps output files from being half written.
"""


class AcquisitionError(Exception):
    """Bad input or a failed session, told in one line: the file, the place, the value and what was expected."""
