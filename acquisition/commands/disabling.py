"""`robot-acquire disable`: stop and disable every drive of a description, whoever enabled it."""

from ..master import Master, leave_operational, safe_stop
from ..robot import Robot, resolve
from ..transport import open_link


def disable(robot: Robot, place: str) -> list[int]:
    """Node ids of the drives that did not confirm that they are disabled. Afterwards every node is in PRE-OPERATIONAL.

    Nothing is asked first and nothing is refused: a session that still runs ends with a fault, and cannot enable again.
    Raises `AcquisitionError` where the bus cannot be opened.
    """
    bus = resolve(robot, place)
    link = open_link(bus.file, passive=False)
    try:
        master = Master(link, bus)
        unconfirmed = safe_stop(master)
        leave_operational(master)
    finally:
        link.close()
    return unconfirmed
