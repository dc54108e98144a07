"""What PDOs to the drives must carry before tracking commands anything by them."""

from ..errors import AcquisitionError
from ..master import axis_of
from ..protocol import MODE_OF_OPERATION
from ..robot import Bus


def check_carriers(bus: Bus) -> None:
    """PDOs to the drives carry what tracking commands, and nothing else: what we do not know would be set to 0.

    Raises `AcquisitionError` naming the node and the object.
    """
    for drive in bus.drives:
        mode = f"{MODE_OF_OPERATION + axis_of(drive):04X}:0"
        known = {str(entry) for entry in (drive.control, drive.target)} | {mode}
        for entry in (drive.control, drive.target):
            if drive.carrier(entry, "rpdo") is None:
                raise AcquisitionError(f"node {drive.node}: no PDO to the drive carries {entry}: expected one to track")
        if drive.carrier(drive.status, "tpdo") is None:
            raise AcquisitionError(f"node {drive.node}: no PDO from it carries {drive.status}: expected one to track")
        for other in (str(e) for pdo in drive.rpdos for e in pdo.entries if str(e) not in known):
            told = f"node {drive.node}: a PDO to the drive carries {other}"
            raise AcquisitionError(f"{told}: expected only {', '.join(sorted(known))} to track")
