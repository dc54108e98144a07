"""Virtual buses of python-can for tests: drives in real time, and an ear that hears all frames."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from made_up_buses import bus_of, bus_text, robot_of

from acquisition.bus import Frame, open_link
from acquisition.robot import BusFile
from acquisition.simulated import SimulatedDrives, serve


def bus_file(channel: str = "test", interface: str = "virtual") -> BusFile:
    return BusFile(interface=interface, channel=channel, drive=(), sync_period_s=1.0, master_node=0)


class Ear:
    def __init__(self, channel: str, interface: str = "virtual") -> None:
        self._link = open_link(bus_file(channel, interface), passive=True)

    def frames(self) -> list[Frame]:
        found = list(iter(lambda: self._link.take(0), None))
        self._link.close()
        return found


@contextmanager
def served(channel: str, n: int) -> Iterator[None]:
    """`n` simulated drives in real time, nodes from 1."""
    robot = robot_of(bus_text(n, channel=channel))
    with serving(SimulatedDrives(robot, bus_of(robot))):
        yield


@contextmanager
def serving(drives: SimulatedDrives) -> Iterator[None]:
    """Simulated drives on their bus in this process, in real time."""
    stop, booted = threading.Event(), threading.Event()
    thread = threading.Thread(target=serve, args=(drives, stop.is_set, booted.set), daemon=True)
    thread.start()
    try:
        assert booted.wait(10)
        yield
    finally:
        stop.set()
        thread.join(10)
