"""What a master commands at each SYNC: a controlword (6040h) and target counts (607Ah) for every drive, by PDO."""

from ..protocol import MODE_OF_OPERATION, Mode
from ..robot import axis_of
from .master import Master, NodeWatch

Orders = list[tuple[int, int]]  # controlword and target counts of each drive, in the order of the drives


def send_orders(master: Master, orders: Orders) -> None:
    """Send the orders to all drives by PDO. Raises `AcquisitionError` when the bus takes no frame."""
    for watch, (control, target) in zip(master.nodes, orders, strict=True):
        send_order(master, watch, control, target)


def send_order(master: Master, watch: NodeWatch, control: int, target: int) -> None:
    """Send the RPDOs of one drive that carry a command and nothing else. Raises `AcquisitionError` as above."""
    drive = watch.drive
    values = {
        (drive.control.index, drive.control.sub): control,
        (drive.target.index, drive.target.sub): target,
        (MODE_OF_OPERATION + axis_of(drive), 0): int(Mode.CYCLIC_SYNCHRONOUS_POSITION),
    }
    for pdo in drive.rpdos:
        if all((entry.index, entry.sub) in values for entry in pdo.entries):
            master.link.send(pdo.can_id, pdo.pack(values))
