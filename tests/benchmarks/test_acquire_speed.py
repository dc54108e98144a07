"""Speed of recording and decoding.

Run with `pytest tests/benchmarks -s --benchmark-enable`; figures stand in acquire_speed.md.

There is no CAN adapter here: datagrams on loopback stand in for the frames of a CAN socket. Kernel
queue, time stamps, drop counter, the recorder's process and its file are the real ones. The bus is
full at 9 000 frames/s of 8 bytes at 1 Mbit/s.
"""

import multiprocessing
import os
import resource
import socket
import struct
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.bus import Receiver, kernel_drops, request_queue_size
from acquisition.recording import FRAME, decode, read_recording
from acquisition.session import Recorder
from acquisition.session.process import _record

TEXT = bus_text(4, period_s=0.0011, interface="socketcan", channel="can0")
TEXT = TEXT.replace("node = 1\n", 'node = 1\nrpdo = [{ objects = ["6040"] }]\n')
DRIVES = 4
SO_TIMESTAMPNS = 35
RATE_HZ, SECONDS = 9_000, 60.0


def some_frames(syncs: int, drives: int = 6) -> np.ndarray:
    rng = np.random.default_rng(0)
    per = 1 + 2 * drives
    frames = np.zeros((syncs, per), FRAME)
    frames["time_ns"] = (
        10**9
        + np.arange(syncs)[:, None] * 2_000_000
        + np.arange(per) * 100_000
        + rng.integers(0, 50_000, (syncs, per))
    )
    frames["can_id"] = np.array(
        [0x80] + [0x181 + i for i in range(drives)] + [0x201 + i for i in range(drives)]
    )
    frames["length"] = np.array([0] + [8] * drives + [6] * drives)
    counts = np.cumsum(rng.integers(-300, 300, (syncs, drives)), axis=0).astype("<i4")
    effort = np.clip(rng.normal(0, 300, (syncs, drives)), -32768, 32767).astype("<i2")
    tpdo, rpdo = frames["data"][:, 1 : 1 + drives], frames["data"][:, 1 + drives :]
    tpdo[:, :, :2] = [0x37, 0x12]
    tpdo[:, :, 2:6] = counts.view("u1").reshape(syncs, drives, 4)
    tpdo[:, :, 6:8] = effort.view("u1").reshape(syncs, drives, 2)
    rpdo[:, :, 0] = 15
    rpdo[:, :, 2:6] = counts.view("u1").reshape(syncs, drives, 4)
    return frames.ravel()


def _recorder(connection, port: int, path: str) -> None:
    """The recorder's process, with a datagram socket in the place of the CAN socket."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    request_queue_size(sock)
    sock.bind(("127.0.0.1", port))
    robot = robot_of(TEXT)
    recorder = Recorder(Path(path), robot, source="benchmark", place="robot.toml")
    finish, times = recorder.finish, []

    def timed_finish(stamp_ns):
        used = resource.getrusage(resource.RUSAGE_SELF)
        times.append((used.ru_utime + used.ru_stime, kernel_drops(sock)))
        return finish(stamp_ns)

    recorder.finish = timed_finish  # type: ignore[method-assign]
    done = _record(
        connection, recorder, Receiver(SimpleNamespace(socket=sock)), np.zeros(0, np.int64), None
    )
    connection.send(("done", (done, *times[0])))


def _busy() -> None:
    while True:
        sum(range(10_000))


def test_full_bus_for_a_minute_on_a_busy_machine(tmp_path):
    context, path = multiprocessing.get_context("fork"), tmp_path / "a.mcap"
    here, there = context.Pipe()
    port = 45000 + os.getpid() % 10000
    recorder, beside = (
        context.Process(target=_recorder, args=(there, port, str(path))),
        context.Process(target=_busy),
    )
    recorder.start()
    there.close()
    assert here.recv()[0] == "ready"
    beside.start()
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.connect(("127.0.0.1", port))
    sent_frames = some_frames(2000, DRIVES)  # as the kernel's CAN socket gives them
    frames = [
        struct.pack("<IB3x8s", one["can_id"], one["length"], one["data"].tobytes())
        for one in sent_frames
    ]
    total = round(RATE_HZ * SECONDS)
    start, sent = time.perf_counter(), 0
    while sent < total:
        due = min(total, int((time.perf_counter() - start) * RATE_HZ))
        for k in range(sent, due):
            out.send(frames[k % len(frames)])
        sent = max(sent, due)
        time.sleep(0.0005)
    elapsed = time.perf_counter() - start
    time.sleep(0.3)
    here.send(("stop", time.time_ns()))
    while (message := here.recv())[0] != "done":
        pass
    _, cpu_s, drops = message[1]
    recorder.join()
    beside.kill()
    beside.join()
    stored = len(read_recording(path).frames["can0"])
    print(
        f"\n{RATE_HZ} frames/s for {SECONDS:g} s beside a busy process: {sent} sent, "
        f"{sent - stored} lost (bound 0)"
    )
    print(f"{drops} dropped by the kernel; recorder: {cpu_s / elapsed:.1%} of a core (bound 25 %)")
    assert stored == sent


def test_decoding():
    robot = robot_of(bus_text(6))
    bus, frames = bus_of(robot), some_frames(150_000)
    best = min(_timed(lambda: decode(frames, robot, bus, "x")) for _ in range(5))
    floor = min(
        _timed(lambda: [np.flatnonzero(frames["can_id"] == i) for i in range(0x181, 0x18E)])
        for _ in range(5)
    )
    told = (
        f"{len(frames) / best / 1e6:.1f} million frames/s (bound 5), {best / floor:.1f} x a "
        "bare search for their ids"
    )
    print(f"\ndecoding {len(frames)} frames of six drives with targets: {told}")


def _timed(run) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start
