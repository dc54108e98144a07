"""Sessions over separate processes on loopback: emulate | record, kills, signals,
full disks; SYNC is slow.
"""

import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import session_processes as processes
from busy_machine import stalls, tried_again
from conftest import ROOT
from session_processes import (
    LAST,
    count,
    drives,
    folder,
    frames_of,
    output_of,
    port,
    syncs_tracked,
    texts,
)

from acquisition.commands import main
from acquisition.protocol import State
from acquisition.recording import SENT, read_recording

__all__ = ["folder", "port"]  # fixtures
LARGEST_FILE = 12_000  # bytes: full in the middle of the reference


def failure_of(session: "subprocess.Popen[str]") -> str:
    _, errors = session.communicate(timeout=processes.PATIENCE_S)
    assert session.returncode == 1
    assert errors.count("\n") == 1
    return errors


def lines_of(path: str) -> list[str]:
    return Path(path).read_text().splitlines()


def recorder_of(pid: int) -> int:
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
            found += [process.name] * (
                parent == pid and b"spawn_main" in (process / "cmdline").read_bytes()
            )
    (recorder,) = found
    return int(recorder)


@tried_again
def test_killed_recorder_stops_session(folder):
    out = folder / "log.mcap"
    with drives(folder), processes.tracking(folder, out) as session, stalls() as worst:
        time.sleep(1.0)  # it writes twice in that
        recorder = recorder_of(session.pid)
        killed_ns = time.time_ns()
        os.kill(recorder, signal.SIGKILL)
        assert "the recorder's process ended" in failure_of(session)
        assert processes.states_of(folder) == [State.SWITCH_ON_DISABLED] * 2
    recording = read_recording(out)
    assert recording.cut
    frames = frames_of(recording)
    assert (killed_ns - frames["time_ns"][-1]) * 1e-9 < 1.0 + 2 * worst[0]
    assert count(frames, 0x80) > processes.SEEN_SYNCS


@tried_again
def test_file_size_limit_stops_session(folder):
    out = folder / "log.mcap"
    with drives(folder):
        command = (
            "record",
            str(folder / "robot.toml"),
            "-o",
            str(out),
            "--yes",
            "--track",
            str(folder / "ref.csv"),
        )
        largest = (LARGEST_FILE, LARGEST_FILE)
        session = processes.acquire(
            folder, *command, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, largest)
        )
        assert "the recording cannot be written: File too large" in failure_of(session)
        assert processes.states_of(folder) == [State.SWITCH_ON_DISABLED] * 2
    recording = read_recording(out)
    assert recording.cut
    assert syncs_tracked(recording) > 0


@tried_again
def test_passive_recording_sends_nothing(folder):
    """What only a master sends by NMT and SDO is as much as in a dry run of the session."""
    text = (folder / "robot.toml").read_text().replace("node = 1", 'mapping = "traffic"\nnode = 1')
    (folder / "passive.toml").write_text(text.replace("node = 2", 'mapping = "traffic"\nnode = 2'))
    out, active, alone = (folder / f"{name}.mcap" for name in ("passive", "active", "alone"))
    ours_ids = (0x80, 0x181, 0x182, 0x201, 0x202)
    command = (
        "record",
        str(folder / "robot.toml"),
        "--yes",
        "--no-fit",
        "--track",
        str(folder / "ref.csv"),
        "-o",
    )
    assert main([*command, str(alone), "--dry-run"]) == 0
    with drives(folder), processes.listening(folder, "passive.toml", out) as listener:
        output_of(processes.acquire(folder, *command, str(active)))
        ours = read_recording(active)
        said = processes.data_by_id(ours, *ours_ids)
        said |= processes.data_by_id(read_recording(alone), 0, 0x601, 0x602)
        # after the states a real session reads supervision, and what is to be confirmed
        for can_id in (0x601, 0x602):
            objects = [(0x1016, 0), (0x1016, 1), (0x1016, 2), (0x6065, 0), (0x6064, 0), (0x6041, 0)]
            said[can_id][1:1] = [
                [0x40, index & 0xFF, index >> 8, k, 0, 0, 0, 0] for index, k in objects
            ]
        processes.wait_for(
            out,
            lambda r: all(count(frames_of(r), can_id) >= len(said[can_id]) for can_id in said),
            listener,
        )
        output_of(listener, signal.SIGINT)
    sent = (frames_of(ours)["flags"] & SENT) != 0
    assert set(frames_of(ours)["can_id"][sent].tolist()) == {
        0,
        0x80,
        0x201,
        0x202,
        0x601,
        0x602,
        0x77F,
    }
    passive = read_recording(out)
    assert not passive.cut
    for can_id, seen in processes.data_by_id(passive, *said).items():
        assert seen[: len(said[can_id])] == said[can_id]
        assert len(seen) <= len(said[can_id]) + (LAST if can_id in ours_ids else 0)
    assert not (frames_of(passive)["flags"] & SENT).any()
    rows, heard = (
        [(*r["position"].round(9), *r["reference"].round(9)) for r in recording.samples]
        for recording in (ours, passive)
    )
    left = iter(rows)
    assert all(row in left for row in heard[: len(heard) - LAST])  # in order
    assert passive.samples["reference"].max(axis=0) == pytest.approx(
        0.6, abs=1e-3
    )  # half a period from the peak at most


@tried_again
def test_killed_follower_does_not_harm_session(
    folder,
):
    out, picture = folder / "log.mcap", folder / "live.rrd"
    with drives(folder), processes.tracking(folder, out, "--speed", "0.02") as session:
        follow = [
            sys.executable,
            "-m",
            "identification",
            "view",
            str(out),
            "--follow",
            "-o",
            str(picture),
        ]
        follower = subprocess.Popen(
            follow, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
        )
        until = time.monotonic() + processes.PATIENCE_S
        while not (picture.exists() and picture.stat().st_size > 20_000):
            assert follower.poll() is None, follower.communicate()
            assert time.monotonic() < until
            time.sleep(0.05)
        own = os.getpriority(os.PRIO_PROCESS, 0)  # the tests may be nice themselves
        assert os.getpriority(os.PRIO_PROCESS, follower.pid) == min(19, own + 10)
        names = [os.readlink(link) for link in Path(f"/proc/{follower.pid}/fd").iterdir()]
        of_bus = [row.split()[9] for k in ("udp", "udp6") for row in lines_of(f"/proc/net/{k}")[1:]]
        assert not {f"socket:[{inode}]" for inode in of_bus} & set(names)
        assert not [
            line for line in lines_of("/proc/locks") if line.split()[-4] == str(follower.pid)
        ]
        assert session.poll() is None, session.communicate()
        follower.kill()
        follower.communicate(timeout=processes.PATIENCE_S)
        killed = syncs_tracked(read_recording(out))
        processes.wait_for(
            out,
            lambda recording: syncs_tracked(recording) >= killed + processes.SEEN_SYNCS,
            session,
        )
        assert output_of(session, signal.SIGINT).endswith("stopped by SIGINT\n")
    recording = read_recording(out)
    assert not recording.cut
    assert texts(recording, "end") == ["stopped by SIGINT"]
    assert texts(recording, "disabled") == ["every drive confirmed"]
    assert texts(recording, "phase")[-3:] == ["track", "stop", "disable"]
    assert len(recording.samples) > 0
