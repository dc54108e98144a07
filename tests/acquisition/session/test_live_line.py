"""What a session tells while it goes on."""

import fcntl
import os
import select
import struct
import sys
import termios
import threading
import time

from made_up_buses import bus_text, robot_of

from acquisition.commands.record import StatusLine, live_line
from acquisition.session import Status


def test_everything_that_matters_is_on_the_line():
    status = Status(
        frames=9000, rate_hz=6501.2, drops=3, late=2, lowest=(-0.5, 0.0), highest=(0.25, 1.0)
    )
    line = live_line(robot_of(bus_text(2)), status, 12.4)
    assert "".join(part for part, _ in line) == (
        "6501 frames/s, 3 dropped, 0 missing, 2 late, joint_1 -0.500..0.250 rad, joint_2 "
        "0.000..1.000 rad, 12 s left"
    )
    assert [part for part, bad in line if bad] == [", 3 dropped", ", 2 late"]


def test_the_line_is_written_without_waiting_and_without_a_thread(monkeypatch):
    """A terminal that nobody reads, or that was stopped by Ctrl-S, takes no text: the SYNC
    loop does not wait for it.
    """
    controller, terminal = os.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 20, 0, 0))
    with open(terminal, "w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        line, threads = StatusLine(), threading.active_count()
        line.show(("x" * 30, False), ("late", True))
        line.show(("y", False))
        line.show()
        line.show()
        expected = "\r\x1b[J" + "x" * 30 + "\x1b[1;31mlate\x1b[0m" + "\r\x1b[1A\x1b[Jy" + "\r\x1b[J"
        text = ""
        while len(text) < len(expected) and select.select([controller], [], [], 5)[0]:
            text += os.read(controller, 1000).decode()
        assert text == expected
        started_s = time.monotonic()
        for _ in range(500):
            line.show(("z" * 1000, False))
        assert time.monotonic() - started_s < 5
        assert threading.active_count() == threads
    os.close(controller)
