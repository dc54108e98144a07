"""Programs of a session as processes on a loopback bus of their own: started, waited for, and what
their recordings hold.
"""

import itertools
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from busy_machine import SYNC_LOST_S, slow_bus_text
from conftest import ROOT
from made_up_buses import bus_of, robot_of

from acquisition.bus import Master, open_link
from acquisition.errors import RobotIdimError
from acquisition.protocol import State
from acquisition.recording import FRAME, Block, Recording, read_recording
from acquisition.robot import BusFile

# The simulated drives as a program, which miss SYNC later than they do by themselves.
DRIVES = f"""import sys
import acquisition.simulated.node as node
from acquisition.commands import main
node.SYNC_LOST_NS = {round(SYNC_LOST_S * 1e9)}
sys.exit(main(sys.argv[1:]))"""
PATIENCE_S = 180  # for what a busy machine does at last
LAST = 3  # frames of a kind that may still be on their way when the recorder is asked to stop
SEEN_SYNCS = 20  # of the reference, before a test does something to a session
PORTS = itertools.cycle(range(20000, 32000))  # below those that systems give out by themselves
for _ in range(os.getpid() * 16 % 12000):
    next(PORTS)


@pytest.fixture
def port() -> Iterator[int]:
    """A port that no other test on this machine uses: each holds the TCP port of the same
    number as long as it runs.
    """
    for number in PORTS:
        with socket.socket() as held:
            try:
                held.bind(("127.0.0.1", number))
            except OSError:
                continue
            yield number
            return


@pytest.fixture
def folder(tmp_path: Path, port: int) -> Path:
    """A description on a bus of its own, and a reference; skips where there is no
    multicast on loopback.
    """
    (tmp_path / "robot.toml").write_text(slow_bus_text(2, channel=f"239.74.163.2:{port}"))
    bus = bus_at(tmp_path)
    try:
        a, b = open_link(bus, passive=False), open_link(bus, passive=True)
    except RobotIdimError as error:
        pytest.skip(f"no multicast on this machine: {error}")
    with closing(a), closing(b):
        a.send(0x123, b"x")
        if b.receive(time.time_ns() + 5 * 10**9) is None:
            pytest.skip("no multicast on loopback here: a route to 239.0.0.0/8 on lo may be needed")
    t = np.arange(0, 6.001, 0.004)
    q = 0.3 * (1 - np.cos(2 * np.pi * t / 6))
    rows = np.column_stack([t, q, q])
    np.savetxt(
        tmp_path / "ref.csv", rows, delimiter=",", header="time_s,joint_1,joint_2", comments=""
    )
    return tmp_path


def bus_at(folder: Path) -> BusFile:
    return robot_of((folder / "robot.toml").read_text()).bus


def acquire(
    folder: Path,
    *arguments: str,
    program: tuple[str, str] = ("-m", "acquisition"),
    **options: object,
) -> "subprocess.Popen[str]":
    command = [sys.executable, *program, *arguments]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, **options
    )  # type: ignore[call-overload,no-any-return]


@contextmanager
def drives(folder: Path, *options: str) -> Iterator["subprocess.Popen[str]"]:
    ear = open_link(bus_at(folder), passive=True)
    command = ("emulate", str(folder / "robot.toml"), "--duration", "600", *options)
    process = acquire(folder, *command, program=("-c", DRIVES))
    try:
        assert "simulated drives, nodes 1, 2" in process.stderr.readline()
        until_ns, silent = time.time_ns() + PATIENCE_S * 10**9, {0x701, 0x702}
        while silent:
            frame = ear.receive(until_ns)
            assert frame is not None, "no boot-up of the simulated drives"
            silent.discard(frame.can_id)
        yield process
    finally:
        ear.close()
        end(process, signal.SIGTERM)


def end(process: "subprocess.Popen[str]", number: signal.Signals) -> tuple[str, str]:
    """Signal a process that still runs; its output."""
    if process.poll() is None:
        process.send_signal(number)
    return process.communicate(timeout=PATIENCE_S)


def output_of(process: "subprocess.Popen[str]", number: signal.Signals | None = None) -> str:
    """What a process printed, after a signal if one is given; it ended in order."""
    if number is not None:
        process.send_signal(number)
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    return output


def wait_for(
    path: Path, done: Callable[[Recording], bool], process: "subprocess.Popen[str] | None" = None
) -> Recording:
    """Read the recording that grows at `path` until it is as wanted;
    `process` is not to end before.
    """
    until, size = time.monotonic() + PATIENCE_S, 0
    while True:
        running = process is None or process.poll() is None
        if path.exists() and path.stat().st_size != size:
            size = path.stat().st_size
            with suppress(RobotIdimError):  # it has only begun
                recording = read_recording(path)
                if done(recording):
                    return recording
        assert running, process.communicate(timeout=PATIENCE_S) if process is not None else ""
        assert time.monotonic() < until, f"{path}: {size} bytes: never as wanted"
        time.sleep(0.05)


def frames_of(recording: Recording) -> Block:
    return next(iter(recording.frames.values()), np.zeros(0, FRAME))


def data_by_id(recording: Recording, *ids: int) -> dict[int, list[list[int]]]:
    frames = frames_of(recording)
    return {can_id: frames["data"][frames["can_id"] == can_id].tolist() for can_id in ids}


def count(frames: Block, can_id: int) -> int:
    return int(np.count_nonzero(frames["can_id"] == can_id))


def syncs_tracked(recording: Recording) -> int:
    """SYNCs since the session began to follow the reference."""
    since = [
        event.stamp_ns
        for event in recording.events
        if (event.kind, event.text) == ("phase", "track")
    ]
    frames = frames_of(recording)
    return count(frames[frames["time_ns"] >= since[0]], 0x80) if since else 0


@contextmanager
def tracking(folder: Path, out: Path, *options: str) -> Iterator["subprocess.Popen[str]"]:
    command = (
        "record",
        str(folder / "robot.toml"),
        "-o",
        str(out),
        "--yes",
        "--no-fit",
        "--track",
        str(folder / "ref.csv"),
    )
    session = acquire(folder, *command, *options)
    try:
        wait_for(out, lambda recording: syncs_tracked(recording) >= SEEN_SYNCS, session)
        yield session
    finally:
        end(session, signal.SIGTERM)


@contextmanager
def listening(folder: Path, description: str, out: Path) -> Iterator["subprocess.Popen[str]"]:
    """A passive recorder that misses nothing from here on: it opens the bus before its file."""
    listener = acquire(folder, "record", str(folder / description), "-o", str(out), "--passive")
    try:
        wait_for(out, lambda recording: True, listener)
        yield listener
    finally:
        end(listener, signal.SIGTERM)


def states_of(folder: Path) -> list[State]:
    """The states of the drives, asked when nobody else asks."""
    bus = bus_of(robot_of((folder / "robot.toml").read_text()))
    with closing(open_link(bus.file, passive=False)) as link:
        return [Master(link, bus).state(drive) for drive in bus.drives]


def texts(recording: Recording, kind: str) -> list[str]:
    return [event.text for event in recording.events if event.kind == kind]
