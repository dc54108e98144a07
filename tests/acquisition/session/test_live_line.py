"""What a session tells while it goes on, and when a passive one ends."""

import fcntl
import os
import select
import struct
import sys
import termios
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dry_sessions import dry_session, swing
from made_up_buses import bus_text, robot_of

import acquisition.session.running as running
from acquisition.bus import Frame
from acquisition.commands.record import StatusLine, live_line
from acquisition.errors import BusFaultError
from acquisition.recording import read_recording
from acquisition.robot import Robot
from acquisition.session import (
    InlineLog,
    Recorder,
    RecordOptions,
    Status,
    Stop,
    Task,
    UserInterface,
    record,
)


def test_live_line_content():
    lost = {"late": 2, "missing": 0, "duplicate": 1, "short": 1}
    status = Status(
        frames=9000, rate_hz=6501.2, drops=3, losses=lost, lowest=(-0.5, 0.0), highest=(0.25, 1.0)
    )
    line = live_line(robot_of(bus_text(2)), status, 12.4)
    assert "".join(part for part, _ in line) == (
        "6501 frames/s, 3 dropped, 0 missing, 2 late, joint_1 -0.500..0.250 rad, joint_2 "
        "0.000..1.000 rad, 12 s left"
    )
    assert [part for part, bad in line if bad] == [", 3 dropped", ", 2 late"]


def test_live_line_never_blocks(monkeypatch):
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


def test_dry_run_writes_frames_continuously(tmp_path):
    """Every 2 ms SYNC and the answers of two drives: 1500 frames/s, written by the tenth of a
    second.
    """
    out, shown = tmp_path / "a.mcap", list[tuple[int, int]]()

    def show(status: Status, left_s: float) -> None:
        shown.append((len(read_recording(out).frames["test"]), status.frames))

    options, operator = RecordOptions(dry_run=True, duration_s=1.6), UserInterface(show=show)
    record(robot_of(bus_text(2)), "robot.toml", out, options, operator)
    before, after = shown[1:3]
    assert (before[0], after[0]) == (before[1], after[1])
    assert after[0] - before[0] == pytest.approx(750, abs=200)


def test_traffic_mapping_is_known_once_seen(tmp_path):
    task = Task(reference=swing(2, seconds=0.2, amplitude=0.02))
    session, shown = dry_session(tmp_path / "active.mcap", task), []
    robot = robot_of(bus_text(2, drive='mapping = "traffic"'))
    recorder = Recorder(tmp_path / "a.mcap", robot, source="test", place="robot.toml")
    for part in np.array_split(session.frames, 4):  # only the first has the mapping
        recorder.add(part)
        status = recorder.tick(int(part["time_ns"][-1]), 0, now=True)
        shown.append((*status.lowest, *status.highest))
    recorder.close()
    q = session.recording.samples["position"]
    assert shown[-1] == pytest.approx((*q.min(axis=0), *q.max(axis=0)), abs=1e-3)


@pytest.mark.parametrize(
    ("duration_s", "fault", "until_s", "event"),
    [
        (1.0, "", 1.0, ("end", "finished")),
        (None, "", 2.0, ("end", "stopped by SIGINT")),
        (1.0, "bus: gone", 0.0, ("fault", "bus: gone")),
    ],
)
def test_passive_recording_ends_by_time_or_ctrl_c(
    tmp_path, monkeypatch, duration_s, fault, until_s, event
):
    """Its recorder is in this process; time passes only where it sleeps; Ctrl-C comes at 2 s."""
    now_ms, stop, out = [0], Stop(), tmp_path / "a.mcap"

    def sleep(seconds: float) -> None:
        now_ms[0] += round(seconds * 1000)
        stop.reason = "stopped by SIGINT" if now_ms[0] >= 2000 else ""

    def poll(log: InlineLog, stamp_ns: int) -> None:
        if fault:
            raise BusFaultError(fault)

    def inline(path: Path, robot: Robot, place: str, *_: object) -> InlineLog:
        log = InlineLog(Recorder(path, robot, source="test", place=place))
        log.tap(Frame(0, 0x80, b""))
        log._write()
        return log

    clock = {"monotonic": lambda: now_ms[0] / 1000, "monotonic_ns": lambda: 0, "sleep": sleep}
    monkeypatch.setattr(running, "time", SimpleNamespace(**clock))
    monkeypatch.setattr(running, "ProcessLog", inline)
    monkeypatch.setattr(InlineLog, "poll", poll)
    notes = ["bumped"]
    options, operator = (
        RecordOptions(passive=True, duration_s=duration_s),
        UserInterface(stop=stop, notes=lambda: [notes.pop()] if notes else []),
    )
    with pytest.raises(BusFaultError) if fault else nullcontext():
        record(robot_of(bus_text(1)), "robot.toml", out, options, operator)
    assert now_ms == [until_s * 1000]
    events = [(found.kind, found.text) for found in read_recording(out).events]
    assert [found for found in events if found[0] in ("end", "fault")] == [event]
    assert ("operator", "bumped") in events
