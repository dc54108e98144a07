"""Sessions over separate processes on loopback: emulate | record, kills, signals, full disks.

They run on machines that are busy with other things: SYNC is slow, so that a process may be held up for a while, and what
a test needs is waited for where it shows, on the bus or in the growing file.
"""

import itertools
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from busy_machine import SYNC_LOST_S, SYNC_S, slow_bus_text, stalls, tried_again
from conftest import ROOT
from made_up_buses import robot_of

from acquisition.bus import Receiver, open_bus, open_link
from acquisition.commands import main
from acquisition.errors import AcquisitionError
from acquisition.recording import FRAME, SENT, Block, Recording, read_recording
from acquisition.robot import BusFile

# The simulated drives as a program, which miss SYNC later than they do by themselves.
DRIVES = f"""import sys
import acquisition.simulated.node as node
from acquisition.commands import main
node.SYNC_LOST_NS = {round(SYNC_LOST_S * 1e9)}
sys.exit(main(sys.argv[1:]))"""
LARGEST_FILE = 12_000  # bytes: full in the middle of the reference
PATIENCE_S = 180  # for what a busy machine does at last
LAST = 3  # frames of a kind that may still be on their way when the recorder is asked to stop
SEEN_SYNCS = 20  # of the reference, before a test does something to a session
PORTS = itertools.cycle(range(20000, 32000))  # below those that systems give out by themselves
for _ in range(os.getpid() * 16 % 12000):
    next(PORTS)


@pytest.fixture
def port() -> Iterator[int]:
    """A port that no other test on this machine uses: each holds the TCP port of the same number as long as it runs."""
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
    """A description on a bus of its own, and a reference; skips where there is no multicast on loopback.

    `check.toml` differs in its SYNC only, of which a check measures 200 periods.
    """
    channel = f"239.74.163.2:{port}"
    text = slow_bus_text(2, channel=channel)
    (tmp_path / "robot.toml").write_text(text)
    (tmp_path / "check.toml").write_text(text.replace(f"sync_period_s = {SYNC_S}", "sync_period_s = 0.002"))
    bus = bus_at(tmp_path)
    try:
        a, b = open_link(bus, passive=False), open_link(bus, passive=True)
    except AcquisitionError as error:
        pytest.skip(f"no multicast on this machine: {error}")
    try:
        a.send(0x123, b"x")
        until = time.time_ns() + 5 * 10**9
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


def bus_at(folder: Path) -> BusFile:
    return robot_of((folder / "robot.toml").read_text()).bus


def acquire(
    folder: Path, *arguments: str, program: tuple[str, str] = ("-m", "acquisition"), **options: object
) -> "subprocess.Popen[str]":
    command = [sys.executable, *program, *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, **options)  # type: ignore[call-overload,no-any-return]


@contextmanager
def drives(folder: Path, *options: str) -> Iterator["subprocess.Popen[str]"]:
    """Simulated drives that have reported that they run."""
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
    path: Path,
    done: Callable[[Recording], bool],
    process: "subprocess.Popen[str] | None" = None,
) -> Recording:
    """Read the recording that grows at `path` until it is as wanted; `process` is not to end before."""
    until, size = time.monotonic() + PATIENCE_S, 0
    while True:
        running = process is None or process.poll() is None
        if path.exists() and path.stat().st_size != size:
            size = path.stat().st_size
            with suppress(AcquisitionError):  # it has only begun
                recording = read_recording(path)
                if done(recording):
                    return recording
        assert running, process.communicate(timeout=PATIENCE_S) if process is not None else ""
        assert time.monotonic() < until, f"{path}: {size} bytes: never as wanted"
        time.sleep(0.05)


def frames_of(recording: Recording) -> Block:
    """The frames of its only channel; none before the first."""
    return next(iter(recording.frames.values()), np.zeros(0, FRAME))


def data_by_id(recording: Recording, *ids: int) -> dict[int, list[list[int]]]:
    """What was in the frames of each identifier, in order."""
    frames = frames_of(recording)
    return {can_id: frames["data"][frames["can_id"] == can_id].tolist() for can_id in ids}


def count(frames: Block, can_id: int) -> int:
    return int(np.count_nonzero(frames["can_id"] == can_id))


def syncs_tracked(recording: Recording) -> int:
    """SYNCs since the session began to follow the reference."""
    since = [event.stamp_ns for event in recording.events if (event.kind, event.text) == ("phase", "track")]
    frames = frames_of(recording)
    return count(frames[frames["time_ns"] >= since[0]], 0x80) if since else 0


@contextmanager
def tracking(folder: Path, out: Path, *options: str) -> Iterator["subprocess.Popen[str]"]:
    """A session that follows the reference, with `SEEN_SYNCS` of that on the disk."""
    command = ("record", str(folder / "robot.toml"), "-o", str(out), "--yes", "--track", str(folder / "ref.csv"))
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


def checked(folder: Path) -> str:
    """What a check tells of the drives; how evenly this machine could send SYNC is left to the machine."""
    output, _ = acquire(folder, "check", str(folder / "check.toml")).communicate(timeout=PATIENCE_S)
    return output


def failure_of(session: "subprocess.Popen[str]") -> str:
    """The one line that a session ends with, whose exit status is 1."""
    _, errors = session.communicate(timeout=PATIENCE_S)
    assert session.returncode == 1
    assert errors.count("\n") == 1
    return errors


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
    """The recorder process of a session."""
    for child in children(pid):
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
            return child
    raise AssertionError("no recorder")


def texts(recording: Recording, kind: str) -> list[str]:
    return [event.text for event in recording.events if event.kind == kind]


def test_simulate_check_record(folder):
    out = folder / "log.mcap"
    with drives(folder):
        output = checked(folder)
        assert re.search(r"^ok  state +1, 2  switch on disabled$", output, re.MULTILINE)
        assert re.search(r"^ok  description +agrees", output, re.MULTILINE)
        output = output_of(acquire(folder, "record", str(folder / "robot.toml"), "-o", str(out), "--duration", "2"))
    assert output.endswith("CAN frames; finished\n")
    recording = read_recording(out)
    frames = frames_of(recording)
    sent = (frames["flags"] & SENT) != 0
    assert set(frames["can_id"][sent].tolist()) <= {0, 0x80, 0x601, 0x602}
    # SYNC never comes faster than asked for; a machine that stalls leaves some out.
    syncs = count(frames, 0x80)
    assert 0.5 * 2 / SYNC_S <= syncs <= 2 / SYNC_S + 1
    # Every answer to SYNC is there, and becomes a sample.
    for node in (1, 2):
        assert syncs - LAST <= count(frames, 0x180 + node) <= syncs
    assert syncs - LAST <= len(recording.samples) <= syncs
    counters = recording.health[-1].counters
    assert (counters["missing"], counters["duplicate"]) == (0, 0)  # between the first and the last
    assert recording.health[-2].counters["kernel_drops"] == 0


@tried_again
def test_a_killed_recorder_leaves_all_but_the_last_second_and_stops_the_session(folder):
    out = folder / "log.mcap"
    with drives(folder), tracking(folder, out) as session, stalls() as worst:
        time.sleep(1.0)  # it writes twice in that
        recorder = recorder_of(session.pid)
        killed_ns = time.time_ns()
        os.kill(recorder, signal.SIGKILL)
        assert "the recorder has ended" in failure_of(session)
        assert "1, 2  switch on disabled" in checked(folder)
    recording = read_recording(out)
    assert recording.cut
    frames = frames_of(recording)
    assert (killed_ns - frames["time_ns"][-1]) * 1e-9 < 1.0 + 2 * worst[0]
    whole, decoded = folder / "whole.mcap", folder / "decoded.mcap"
    assert main(["import", str(out), "-o", str(whole)]) == main(["import", str(whole), "-o", str(decoded)]) == 0
    samples = read_recording(decoded).samples
    assert SEEN_SYNCS < count(frames, 0x80) - 3 <= len(samples)  # answers to the last ones may be behind the cut
    assert "reference" in samples.dtype.names


@tried_again
def test_drives_whose_session_and_recorder_are_killed_stop_by_themselves(folder):
    """No process is left that could stop them: SYNC is lost while they are enabled."""
    out = folder / "log.mcap"
    with drives(folder), tracking(folder, out) as session:
        os.kill(recorder_of(session.pid), signal.SIGKILL)
        session.kill()
        session.communicate(timeout=PATIENCE_S)
        assert "1, 2  fault: remove its cause" in checked(folder)
    assert read_recording(out).cut


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@tried_again
def test_signals_end_a_session_in_order(folder, number):
    out = folder / "log.mcap"
    with drives(folder), tracking(folder, out) as session:
        output = output_of(session, number)
        assert output.endswith(f"stopped by {number.name}\n")
    recording = read_recording(out)
    assert not recording.cut
    assert texts(recording, "end") == [f"stopped by {number.name}"]
    assert texts(recording, "disabled") == ["every drive confirmed"]
    assert texts(recording, "phase")[-3:] == ["track", "stop", "disable"]


@tried_again
def test_a_file_that_cannot_grow_stops_the_session(folder):
    out = folder / "log.mcap"
    with drives(folder):
        session = acquire(
            folder, "record", str(folder / "robot.toml"), "-o", str(out), "--yes", "--track", str(folder / "ref.csv"),
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE, LARGEST_FILE)),
        )  # fmt: skip
        assert "cannot be written: File too large" in failure_of(session)
        assert "1, 2  switch on disabled" in checked(folder)
    recording = read_recording(out)
    assert recording.cut
    assert syncs_tracked(recording) > 0


@tried_again
def test_passive_records_another_masters_session_and_sends_nothing(folder):
    """The master is our own active session; its targets are the reference.

    What only a master sends by NMT and SDO is as much as in a dry run of the session, where nobody else is on the bus.
    """
    text = (folder / "robot.toml").read_text().replace("node = 1", 'mapping = "traffic"\nnode = 1')
    (folder / "passive.toml").write_text(text.replace("node = 2", 'mapping = "traffic"\nnode = 2'))
    out, active, alone = (folder / f"{name}.mcap" for name in ("passive", "active", "alone"))
    ours_ids = (0x80, 0x181, 0x182, 0x201, 0x202)
    command = ("record", str(folder / "robot.toml"), "--yes", "--track", str(folder / "ref.csv"), "-o")
    assert main([*command, str(alone), "--dry-run"]) == 0
    with drives(folder), listening(folder, "passive.toml", out) as listener:
        output_of(acquire(folder, *command, str(active)))
        ours = read_recording(active)
        said = data_by_id(ours, *ours_ids)
        said |= data_by_id(read_recording(alone), 0, 0x601, 0x602)
        for can_id in (0x601, 0x602):  # after the states a real session reads supervision, and what is to be confirmed
            objects = [(0x1016, 0), (0x1016, 1), (0x1016, 2), (0x6065, 0), (0x6064, 0), (0x6041, 0)]
            said[can_id][1:1] = [[0x40, index & 0xFF, index >> 8, k, 0, 0, 0, 0] for index, k in objects]
        wait_for(out, lambda r: all(count(frames_of(r), can_id) >= len(said[can_id]) for can_id in said), listener)
        output_of(listener, signal.SIGINT)
    sent = (frames_of(ours)["flags"] & SENT) != 0
    assert set(frames_of(ours)["can_id"][sent].tolist()) == {0, 0x80, 0x201, 0x202, 0x601, 0x602, 0x77F}
    passive = read_recording(out)
    assert not passive.cut
    for can_id, seen in data_by_id(passive, *said).items():
        assert seen[: len(said[can_id])] == said[can_id]
        assert len(seen) <= len(said[can_id]) + (LAST if can_id in ours_ids else 0)
    assert not (frames_of(passive)["flags"] & SENT).any()
    a, b = ours.samples, passive.samples
    # SYNC that comes a period late looks to a listener as if one were lost: rows about it are refused.
    late = int((np.diff(frames_of(passive)["time_ns"][frames_of(passive)["can_id"] == 0x80]) > 1.5e9 * SYNC_S).sum())
    assert len(a) - 6 * late <= len(b) <= len(a) + LAST
    rows, heard = ([(*r["position"].round(9), *r["reference"].round(9)) for r in samples] for samples in (a, b))
    left = iter(rows)
    assert all(row in left for row in heard[: len(b) - LAST])  # in order
    assert b["reference"].max(axis=0) == pytest.approx(0.6, abs=1e-3)  # half a period from the peak at most


def test_a_receiver_that_is_told_to_stop_takes_what_has_arrived(folder):
    handle, sender = open_bus(bus_at(folder), passive=True), open_link(bus_at(folder), passive=False)
    try:
        receiver = Receiver(handle)
        for _ in range(200):
            sender.send(0x123, b"x")
        thread = threading.Thread(target=receiver.run)
        thread.start()
        receiver.stopped = True
        thread.join(10)
        assert len(receiver.take()) == 200
    finally:
        handle.shutdown()
        sender.close()


@tried_again
def test_a_follower_that_is_killed_in_motion_harms_nothing(folder):
    """It is nice, holds no socket of the bus and no lock; the recording is whole, and the motion goes on."""
    out, picture = folder / "log.mcap", folder / "live.rrd"
    with drives(folder), tracking(folder, out, "--speed", "0.02") as session:
        follow = [sys.executable, "-m", "identification", "view", str(out), "--follow", "-o", str(picture)]
        follower = subprocess.Popen(follow, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
        until = time.monotonic() + PATIENCE_S
        while not (picture.exists() and picture.stat().st_size > 20_000):
            assert follower.poll() is None, follower.communicate()
            assert time.monotonic() < until
            time.sleep(0.05)
        own = os.getpriority(os.PRIO_PROCESS, 0)  # the tests may be nice themselves
        assert os.getpriority(os.PRIO_PROCESS, follower.pid) == min(19, own + 10)
        names = [os.readlink(link) for link in Path(f"/proc/{follower.pid}/fd").iterdir()]
        of_bus = [
            line.split()[9]
            for kind in ("udp", "udp6")
            for line in Path(f"/proc/net/{kind}").read_text().splitlines()[1:]
        ]
        assert not {f"socket:[{inode}]" for inode in of_bus} & set(names)
        assert not [
            line for line in Path("/proc/locks").read_text().splitlines() if line.split()[-4] == str(follower.pid)
        ]
        assert session.poll() is None, session.communicate()
        follower.kill()
        follower.communicate(timeout=PATIENCE_S)
        killed = syncs_tracked(read_recording(out))
        wait_for(out, lambda recording: syncs_tracked(recording) >= killed + SEEN_SYNCS, session)
        output_of(session, signal.SIGINT)
    recording = read_recording(out)
    assert not recording.cut
    assert texts(recording, "end") == ["stopped by SIGINT"]
    assert len(recording.samples) > 0
