"""Stacks of others: npm's `canopen` as drive and as master, and Python's `canopen` as master
of our simulated drives.
"""

import json
import queue
import re
import signal
import threading
import tomllib
from pathlib import Path

import canopen
import numpy as np
import pytest
from busy_machine import SYNC_S, slow_bus_text
from made_up_buses import bus_of, bus_text, robot_of
from session_processes import (
    LAST,
    PATIENCE_S,
    acquire,
    bus_at,
    count,
    data_by_id,
    drives,
    end,
    folder,
    frames_of,
    listening,
    output_of,
    port,
    wait_for,
)
from third_party_drives import node, npm, third_party_drive
from virtual_buses import Ear

from acquisition.recording import read_recording
from acquisition.simulated import SimulatedDrives, serve
from acquisition.simulated import node as simulated_supervision

__all__ = ["folder", "npm", "port"]  # fixtures


def test_third_party_drive_is_recorded(folder, npm):
    """Its motion is known: every sample is what it sent, in number and value."""
    text = slow_bus_text(1, ratio=1.0, channel=bus_at(folder).channel)
    text = text.replace("node = 1\n", "node = 7\n").replace("65536", "6553600")
    (folder / "npm.toml").write_text(text)
    out = folder / "log.mcap"
    with third_party_drive(folder, npm) as drive:
        output_of(
            acquire(folder, "record", str(folder / "npm.toml"), "-o", str(out), "--duration", "3")
        )
        output = end(drive, signal.SIGTERM)[1]
    recording = read_recording(out)
    frames = frames_of(recording)
    syncs = count(frames, 0x80)
    pdos = frames[frames["can_id"] == 0x187]
    assert syncs >= 0.5 * 3 / SYNC_S
    # each is answered once; its values tell that none lacks in between
    assert syncs - LAST <= len(pdos) <= syncs
    assert "node 7 end: rx" in output
    # k counts SYNCs since it became operational; T is 1 ms whatever the clock.
    k = np.arange(1, len(pdos) + 1)
    w = 2 * np.pi * (0.2 + 0.05 * 7)
    q, v, a = (
        0.5 * np.sin(w * k * 1e-3),
        0.5 * w * np.cos(w * k * 1e-3),
        -0.5 * w * w * np.sin(w * k * 1e-3),
    )
    counts = np.rint(q * 6553600 / (2 * np.pi))
    assert pdos["data"][:, 2:6].copy().view("<i4")[:, 0].tolist() == counts.tolist()
    torque = 60 * a + 80 * v + 25 * np.sign(v) + 200 * np.cos(q)
    assert np.abs(pdos["data"][:, 6:8].copy().view("<i2")[:, 0] - torque).max() <= 0.5 + 1e-9
    samples = recording.samples
    assert len(samples) >= len(pdos) - 1  # the second PDO may be behind the end
    q_counts = np.rint(samples["position"][:, 0] * 6553600 / (2 * np.pi))
    first = int(np.flatnonzero(counts == q_counts[0])[0])
    assert (
        q_counts.tolist() == counts[first : first + len(q_counts)].tolist()
    )  # one after the other; a busy machine sends late


def test_third_party_drive_is_scanned(folder, npm):
    """Beside two simulated drives; what goes to the drives are reads of objects."""
    channel = bus_at(folder).channel
    with third_party_drive(folder, npm), drives(folder):
        ear = Ear(channel, "udp_multicast")
        where = ("--interface", "udp_multicast", "--channel", channel)
        output = output_of(acquire(folder, "scan", *where, "--toml", str(folder / "bus.toml")))
        frames = ear.frames()
    from_nodes = [base + node for base in (0x580, 0x700) for node in (1, 2, 7)]
    sent = [frame for frame in frames if frame.can_id not in from_nodes]
    assert len(sent) > 127
    assert {(frame.can_id & 0x780, frame.data[0]) for frame in sent} == {(0x600, 0x40)}
    (bus,) = tomllib.loads(
        (folder / "bus.toml").read_text().replace("# counts_per_turn = ...", "counts_per_turn = 1")
    ).values()
    assert [found["node"] for found in bus["drive"]] == [1, 2, 7]
    assert bus["drive"][2] == {
        "node": 7,
        "reference": "6074",
        "rated_torque_nm": 0.42,
        "counts_per_turn": 1,
    }
    rows = [line for line in output.splitlines() if re.match(r"(ok|NO) .*  7  ", line)]
    assert any("1018:1 0x123, 1018:2 0x192, 1018:3 0x1, 1018:4 0x7" in row for row in rows)
    assert any("6075 5000, 6076 420" in row for row in rows)
    assert any(
        "tpdo 1 0x187 6041 6064 6074; tpdo 2 0x287 606C 6077 6078; rpdo 1 0x207" in row
        for row in rows
    )
    assert any("6092:1 -, 6092:2 -, 6091:1 -, 6091:2 -, 608F:1 -, 608F:2 -" in row for row in rows)


def test_third_party_master_is_recorded(folder, npm):
    """It configures and moves our simulated drives; sent and recorded are
    equal in number and value.
    """
    group, _, master_port = bus_at(folder).channel.partition(":")
    syncs = 120
    text = (folder / "robot.toml").read_text()
    for number in (1, 2):
        text = text.replace(f"node = {number}\n", f'mapping = "traffic"\nnode = {number}\n')
    (folder / "passive.toml").write_text(text)
    out = folder / "passive.mcap"
    with drives(folder), listening(folder, "passive.toml", out) as listener:
        script, period_ms = Path(__file__).with_name("third_party_master.js"), f"{SYNC_S * 1e3:g}"
        output = output_of(node(npm, script, group, master_port, str(syncs), period_ms, "1", "2"))
        ids = (0x80, 0x181, 0x182, 0x201, 0x202)
        wait_for(
            out,
            lambda r: all(len(data) >= syncs for data in data_by_id(r, *ids).values()),
            listener,
        )
        output_of(listener, signal.SIGINT)
    spoken = json.loads(output)
    recording = read_recording(out)
    frames = frames_of(recording)
    assert count(frames, 0x80) == syncs
    for number in (1, 2):
        to_drive = (
            frames[frames["can_id"] == 0x200 + number]["data"][:, 2:6].copy().view("<i4")[:, 0]
        )
        assert to_drive.tolist() == spoken["targets"][str(number)]
        from_drive = (
            frames[frames["can_id"] == 0x180 + number]["data"][:, 2:6].copy().view("<i4")[:, 0]
        )
        assert from_drive.tolist() == spoken["received"][str(number)]
        assert len(to_drive) == len(from_drive) == syncs
    samples = recording.samples
    # A SYNC that this master sends a whole period late, on a busy machine, looks like two with
    # one lost between them.
    late = int((np.diff(frames["time_ns"][frames["can_id"] == 0x80]) > 1.5e9 * SYNC_S).sum())
    assert syncs - 2 * late <= len(samples) <= syncs
    motor = recording.robot.motor_position(samples["reference"]) * 65536 / (2 * np.pi)
    assert np.abs(motor[30:, 0] - np.rint(motor[30:, 0])).max() < 1e-6
    assert motor[:, 0].max() == pytest.approx(100_000, abs=50)
    assert np.ptp(samples["position"][:, 0]) > 0.05  # the drives followed


def test_python_canopen_controls_simulated_drives(monkeypatch):
    """The canopen package, unchanged: boot-up, SDO, PDO mapping, NMT, heartbeat, SYNC."""
    # This master sends SYNC when it has something to say, however long that takes it.
    monkeypatch.setattr(simulated_supervision, "SYNC_LOST_NS", 60 * 10**9)
    robot = robot_of(bus_text(1, channel="python_master"))
    stop = threading.Event()
    network = canopen.Network()
    network.connect(interface="virtual", channel="python_master")
    # The drive comes up once its boot-up is waited for: canopen does not see one that came before.
    thread = threading.Timer(1.0, serve, args=(SimulatedDrives(robot, bus_of(robot)), stop.is_set))
    remote, seen = network.add_node(1, canopen.ObjectDictionary()), queue.Queue()
    remote.sdo.RESPONSE_TIMEOUT = 5.0
    try:
        thread.start()
        remote.nmt.wait_for_bootup(timeout=PATIENCE_S)
        remote.nmt.state = "PRE-OPERATIONAL"
        assert remote.sdo.upload(0x6041, 0)[0] & 0x4F == 0x40
        with pytest.raises(canopen.SdoAbortedError):
            remote.sdo.upload(0x5000, 0)
        mapped = [
            (0x1A00, sub, entry, 4)
            for sub, entry in enumerate((0x60410010, 0x60640020, 0x60740010), 1)
        ]
        off, on = (0x1800, 1, 0x80000181, 4), (0x1800, 1, 0x181, 4)
        for *entry, value, size in (
            off,
            (0x1800, 2, 1, 1),
            (0x1A00, 0, 0, 1),
            *mapped,
            (0x1A00, 0, 3, 1),
            on,
        ):
            remote.sdo.download(*entry, value.to_bytes(size, "little"))
        remote.nmt.state = "OPERATIONAL"
        network.subscribe(0x181, lambda _, data, __: seen.put(bytes(data)))
        for _ in range(5):
            network.sync.transmit()
            assert len(seen.get(timeout=PATIENCE_S)) == 8
        for word, bits in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
            remote.sdo.download(0x6040, 0, word.to_bytes(2, "little"))
            network.sync.transmit()  # it comes to the drive before the request of its status
            assert remote.sdo.upload(0x6041, 0)[0] & 0x6F == bits
        assert seen.qsize() == 3
    finally:
        stop.set()
        thread.join(5)
        network.disconnect()
