"""Sessions over separate processes on loopback: simulate | record, kills, signals, full disks."""

import itertools
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from made_up_buses import bus_text, robot_of

from acquisition import AcquisitionError
from acquisition.blocks import SENT
from acquisition.bus import open_link
from acquisition.recording import Recording, read_recording

PORTS = itertools.count(44000 + os.getpid() % 1000 * 4)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A description on a group of its own, and a reference; skips where there is no multicast on loopback."""
    text = bus_text(2, period_s=0.004, interface="udp_multicast", channel=f"239.74.163.2:{next(PORTS)}")
    (tmp_path / "robot.toml").write_text(text)
    bus = robot_of(text).bus
    assert bus is not None
    try:
        a, b = open_link(bus, passive=False), open_link(bus, passive=True)
    except AcquisitionError as error:
        pytest.skip(f"no multicast on this machine: {error}")
    try:
        a.send(0x123, b"x")
        until = time.time_ns() + 10**9
        frame = b.receive(until)
        if frame is None:
            pytest.skip("no multicast on loopback here: a route to 239.0.0.0/8 on lo may be needed")
    finally:
        a.close()
        b.close()
    t = np.arange(0, 6.001, 0.004)
    q = 0.3 * (1 - np.cos(2 * np.pi * t / 6))
    np.savetxt(
        tmp_path / "ref.csv", np.column_stack([t, q, q]), delimiter=",", header="time_s,joint_1,joint_2", comments=""
    )
    return tmp_path


def acquire(folder: Path, *arguments: str, **options: object) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "acquisition", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, **options)  # type: ignore[call-overload,no-any-return]


@contextmanager
def drives(folder: Path) -> Iterator["subprocess.Popen[str]"]:
    process = acquire(folder, "simulate", str(folder / "robot.toml"), "--duration", "60")
    try:
        assert process.stderr is not None
        assert "simulated drives, nodes 1, 2" in process.stderr.readline()
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=10)


def wait_for(path: Path, size: int, timeout_s: float = 20.0) -> None:
    until = time.monotonic() + timeout_s
    while not (path.exists() and path.stat().st_size > size):
        assert time.monotonic() < until, f"{path} did not grow"
        time.sleep(0.05)


@contextmanager
def tracking(folder: Path, out: Path) -> Iterator["subprocess.Popen[str]"]:
    """A session that follows the reference and has begun to record."""
    session = acquire(folder, "record", str(folder / "robot.toml"), "-o", str(out), "--track", str(folder / "ref.csv"))
    try:
        wait_for(out, 4000)
        yield session
    finally:
        if session.poll() is None:
            session.terminate()
            session.communicate(timeout=20)


def children(pid: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(stat.parent.name))
    return found


def recorder_of(pid: int) -> int:
    """The recorder among a session's processes."""
    for child in children(pid):
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
            return child
    raise AssertionError("no recorder")


def texts(recording: Recording, kind: str) -> list[str]:
    return [event.text for event in recording.events if event.kind == kind]


def test_simulate_check_record(folder):
    out = folder / "log.mcap"
    with drives(folder):
        checked = acquire(folder, "check", str(folder / "robot.toml"))
        told, _ = checked.communicate(timeout=30)
        assert "node 1 (motor_1): switch on disabled" in told
        assert "description: agrees" in told
        done = acquire(folder, "record", str(folder / "robot.toml"), "-o", str(out), "--duration", "2")
        told, errors = done.communicate(timeout=60)
    assert done.returncode == 0, errors
    assert told.endswith("CAN frames; finished\n")
    recording = read_recording(out)
    assert len(recording.samples) > 300
    frames = next(iter(recording.frames.values()))
    sent = (frames["flags"] & SENT) != 0
    assert set(frames["can_id"][sent].tolist()) <= {0, 0x80, 0x601, 0x602}
    assert (frames["can_id"][sent] == 0x80).sum() == pytest.approx(500, abs=10)
    # Every answer to SYNC that was sent is there: as many as SYNCs, but for those still under way at the end.
    for node in (1, 2):
        assert (frames["can_id"] == 0x180 + node).sum() == pytest.approx((frames["can_id"] == 0x80).sum(), abs=2)
    assert recording.health[-2].counters["kernel_drops"] == 0


def test_a_killed_recorder_leaves_all_but_the_last_second_and_stops_the_session(folder):
    out = folder / "log.mcap"
    with drives(folder), tracking(folder, out) as session:
        time.sleep(2.5)
        recorder = recorder_of(session.pid)
        killed_ns = time.time_ns()
        os.kill(recorder, signal.SIGKILL)
        _, errors = session.communicate(timeout=30)
        assert session.returncode == 1
        assert errors.count("\n") == 1
        assert "the recorder has ended" in errors
        checked, _ = acquire(folder, "check", str(folder / "robot.toml")).communicate(timeout=30)
        assert checked.count("switch on disabled") == 2
    recording = read_recording(out)
    assert recording.cut
    frames = next(iter(recording.frames.values()))
    assert (killed_ns - frames["time_ns"][-1]) * 1e-9 < 1.0
    told = json.loads(acquire(folder, "info", str(out), "--json").communicate(timeout=30)[0])
    assert told["cut"] is True
    whole, decoded = folder / "whole.mcap", folder / "decoded.mcap"
    assert acquire(folder, "recover", str(out), "-o", str(whole)).wait(30) == 0
    assert acquire(folder, "decode", str(whole), "-o", str(decoded)).wait(30) == 0
    samples = read_recording(decoded).samples
    assert len(samples) > 400
    assert "reference" in samples.dtype.names


def test_a_killed_session_leaves_a_whole_file_and_drives_that_stop_by_themselves(folder):
    out = folder / "log.mcap"
    with drives(folder), tracking(folder, out) as session:
        time.sleep(1.5)
        recorder = recorder_of(session.pid)
        session.kill()
        session.communicate(timeout=10)
        until = time.monotonic() + 20
        while Path(f"/proc/{recorder}").exists() and time.monotonic() < until:
            time.sleep(0.05)
        checked, _ = acquire(folder, "check", str(folder / "robot.toml")).communicate(timeout=30)
        assert checked.count("fault") >= 2  # SYNC was lost while they were enabled
    recording = read_recording(out)
    assert not recording.cut
    assert texts(recording, "fault") == ["the session's process is gone"]
    assert len(recording.samples) > 100


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_session_in_order(folder, number):
    out = folder / "log.mcap"
    with drives(folder), tracking(folder, out) as session:
        time.sleep(1.5)
        session.send_signal(number)
        told, errors = session.communicate(timeout=30)
        assert session.returncode == 0, errors
        assert told.endswith(f"stopped by {number.name}\n")
    recording = read_recording(out)
    assert not recording.cut
    assert texts(recording, "end") == [f"stopped by {number.name}"]
    assert texts(recording, "disabled") == ["every drive confirmed"]
    assert texts(recording, "phase")[-2:] == ["stop", "disable"]


def test_a_file_that_cannot_grow_stops_the_session(folder):
    out = folder / "log.mcap"
    with drives(folder):
        session = acquire(
            folder, "record", str(folder / "robot.toml"), "-o", str(out), "--track", str(folder / "ref.csv"),
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000)),
        )  # fmt: skip
        _, errors = session.communicate(timeout=40)
        assert session.returncode == 1
        assert errors.count("\n") == 1
        assert "cannot be written: File too large" in errors
        checked, _ = acquire(folder, "check", str(folder / "robot.toml")).communicate(timeout=30)
        assert checked.count("switch on disabled") == 2
    recording = read_recording(out)
    assert recording.cut
    assert len(next(iter(recording.frames.values()))) > 100


def test_passive_records_another_masters_session_and_sends_nothing(folder):
    """The master is our own active session; its targets are the reference."""
    text = (folder / "robot.toml").read_text().replace("node = 1", 'mapping = "traffic"\nnode = 1')
    (folder / "passive.toml").write_text(text.replace("node = 2", 'mapping = "traffic"\nnode = 2'))
    out, active = folder / "passive.mcap", folder / "active.mcap"
    with drives(folder):
        listener = acquire(folder, "record", str(folder / "passive.toml"), "-o", str(out), "--passive")
        wait_for(out, 500)
        time.sleep(0.3)
        session = acquire(
            folder, "record", str(folder / "robot.toml"), "-o", str(active), "--track", str(folder / "ref.csv")
        )
        assert session.wait(60) == 0
        listener.send_signal(signal.SIGINT)
        _, errors = listener.communicate(timeout=30)
    assert listener.returncode == 0, errors
    passive, ours = read_recording(out), read_recording(active)
    assert not (next(iter(passive.frames.values()))["flags"] & SENT).any()
    a, b = ours.samples, passive.samples
    # Both recorders saw the same frames; the passive one may have begun earlier.
    assert b["position"][-len(a) :] == pytest.approx(a["position"])
    assert b["reference"][-len(a) :] == pytest.approx(a["reference"])
    assert np.ptp(b["reference"]) == pytest.approx(0.6, abs=1e-4)


def test_a_recording_is_replayed_with_its_timing(folder):
    out, again = folder / "log.mcap", folder / "again.mcap"
    assert acquire(
        folder, "record", str(folder / "robot.toml"), "-o", str(out), "--dry-run", "--duration", "1.5"
    ).wait(30) == 0  # fmt: skip
    listener = acquire(folder, "record", str(folder / "robot.toml"), "-o", str(again), "--passive")
    wait_for(again, 500)
    time.sleep(0.3)
    channel = robot_of((folder / "robot.toml").read_text()).bus.channel
    replay = acquire(folder, "replay", str(out), "--interface", "udp_multicast", "--channel", channel, "--speed", "1.5")
    told, errors = replay.communicate(timeout=30)
    assert replay.returncode == 0, errors
    time.sleep(0.3)
    listener.send_signal(signal.SIGTERM)
    listener.communicate(timeout=30)
    sent, received = (next(iter(read_recording(path).frames.values())) for path in (out, again))
    assert f"{len(sent)} frames sent" in told
    for field in ("can_id", "length", "data"):
        assert received[field].tolist() == sent[field].tolist()
    assert np.ptp(sent["time_ns"]) / np.ptp(received["time_ns"]) == pytest.approx(1.5, rel=0.05)


def test_known_errors_are_one_line(folder):
    robot = str(folder / "robot.toml")
    (folder / "there.mcap").write_bytes(b"x")
    for arguments, expected in (
        (["record", robot, "-o", str(folder / "there.mcap"), "--dry-run", "--duration", "1"], "is there already"),
        (["record", robot, "-o", str(folder / "a.mcap"), "--passive", "--dry-run"], "--passive: sends nothing"),
        (["record", robot, "-o", str(folder / "a.mcap"), "--duration", "0"], "--duration 0: expected more than 0"),
        (["record", str(ROOT / "replay_data/emps/robot.toml"), "-o", str(folder / "a.mcap")], "bus is not there"),
        (["record", robot, "-o", str(folder / "no" / "a.mcap"), "--duration", "1"], "cannot be written: No such file"),
        (["record", robot, "-o", str(folder / "b.mcap"), "--duration", "1"], "node 1: object 1017:0: no answer"),
        (["check", robot], "no go: node 1 (motor_1), node 2 (motor_2)"),
        (["import", str(folder / "x.log"), "--robot", robot, "-o", str(folder / "o.mcap")], "x.log: cannot be read"),
        (["import", str(folder / "x.csv"), "--robot", robot, "-o", str(folder / "o.mcap")], "--map is not there"),
        (["export", str(folder / "there.mcap"), "-o", str(folder / "o.csv")], "expected an MCAP file"),
        (["replay", str(folder / "there.mcap"), "--interface", "nothing", "--channel", "x"], "expected an MCAP file"),
    ):
        process = acquire(folder, *arguments)
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 1, arguments
        assert errors.count("\n") == 1
        assert expected in errors
