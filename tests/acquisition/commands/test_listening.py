"""Listening before sending: replay on a idle bus only, sessions and checks while another master
is active, NMT by node.
"""

import itertools
import time
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dry_sessions import Edited, Unasked, connected, dry_session, findings, swing
from made_up_buses import bus_of, bus_text, robot_of
from virtual_buses import Ear, bus_file

from acquisition.bus import Frame, open_link, other_node, service_of, sign_of_master
from acquisition.commands import main
from acquisition.errors import BusFaultError, RefusedError, RobotIdimError
from acquisition.recording import EXTENDED, REMOTE_REQUEST, SENT, read_recording
from acquisition.session import InlineLog, Stop, Task, replay, running
from acquisition.simulated import LockStepLink, SimulatedDrives

ROBOT = robot_of(bus_text(2))
BUS = bus_of(ROBOT)
TASKS = [Task(duration_s=0.1), Task(reference=swing(2, seconds=0.4, amplitude=0.02))]


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("listening") / "log.mcap"
    assert not dry_session(path, TASKS[1]).outcome.fault
    return path


# Identifiers of CiA 301 written out; the drives are nodes 1 and 2, with TPDO 1 and RPDO 1 on
# the usual identifiers.
SERVICES = [
    (0x000, "NMT command", True), (0x080, "SYNC", True), (0x081, "emergency of node 1", False),
    (0x181, "TPDO 1 of node 1", False), (0x201, "RPDO 1 to node 1", True),
    (0x303, "RPDO 2 to node 3", True),
    (0x4FF, "TPDO 4 of node 127", False), (0x57F, "RPDO 4 to node 127", True),
    (0x581, "SDO answer of node 1", False),
    (0x602, "SDO request to node 2", True), (0x701, "heartbeat of node 1", False),
    (0x77F, "heartbeat of node 127", True),
    (0x700, "frame 0x700", False), (0x690, "frame 0x690", False),
]  # fmt: skip


@pytest.mark.parametrize(("can_id", "service", "master"), SERVICES)
def test_frame_shows_its_sender(can_id, service, master):
    frame = Frame(0, can_id, b"\x05")
    assert service_of(frame, 0x80) == service
    sign = sign_of_master(frame, BUS)
    assert (sign is not None) == master
    assert sign is None or sign.startswith(service)
    assert sign_of_master(frame._replace(flags=EXTENDED), BUS) is None


def test_frames_without_sign_of_master():
    frame = Frame(0, 0x77F, b"\0")
    assert (service_of(frame, 0x80), sign_of_master(frame, BUS)) == ("boot-up of node 127", None)
    assert [other_node(Frame(0, 0x705, data), BUS) for data in (b"\0", b"\x05")] == [None, 5]
    assert [other_node(Frame(0, can_id, b"\x05"), BUS) for can_id in (0x701, 0x700, 0x185)] == [
        None
    ] * 3
    other = bus_of(robot_of(bus_text(2, extra='sync_producer = "other"')))
    assert sign_of_master(Frame(0, 0x80, b""), other) is None
    swapped = bus_of(robot_of(bus_text(1, drive="""
tpdo = [{ objects = ["6041", "6064", "6074"], can_id = 0x201 }]
rpdo = [{ objects = ["6040", "607A"], can_id = 0x181 }]""")))  # fmt: skip
    assert sign_of_master(Frame(0, 0x201, bytes(8)), swapped) is None
    assert sign_of_master(Frame(0, 0x181, bytes(6)), swapped) == "TPDO 1 of node 1"
    assert (
        sign_of_master(Frame(0, 0x701, b"", REMOTE_REQUEST), swapped)
        == "remote request for heartbeat of node 1"
    )


@pytest.mark.parametrize("can_id", [0x80, 0x83, 0x185, 0x585, 0x701, 0x705, 0x123])
def test_replay_is_refused_on_active_bus(tracked, can_id, monkeypatch):
    file = bus_file(f"replay_{can_id:03X}")
    ear = Ear(file.channel)
    with (
        closing(open_link(file, passive=False)) as somebody,
        closing(open_link(file, passive=False)) as ours,
    ):
        somebody.send(can_id, b"\x01")
        monkeypatch.setattr(running, "open_link", lambda *_, **__: ours)
        with pytest.raises(RefusedError) as caught:
            replay(tracked, file, Stop())
    assert service_of(Frame(0, can_id, b"\x01"), 0x80) in caught.value.why
    assert caught.value.why.endswith(" received); nothing was sent")
    assert [frame.can_id for frame in ear.frames()] == [can_id]


def test_replay_sends_drive_frames_and_sync(tracked):
    file = bus_file("replay_silent")
    ear = Ear(file.channel)
    options = ["--interface", "virtual", "--channel", file.channel, "--speed", "1000"]
    assert main(["emulate", str(tracked), *options]) == 0
    recorded = next(iter(read_recording(tracked).frames.values()))
    drives = np.isin(
        recorded["can_id"], [0x80, 0x81, 0x82, 0x181, 0x182, 0x581, 0x582, 0x701, 0x702]
    )
    expected = recorded[drives]
    assert {0, 0x201, 0x202, 0x601, 0x602} <= set(recorded["can_id"][~drives].tolist())
    assert [(frame.can_id, list(frame.data)) for frame in ear.frames()] == [
        (r["can_id"], r["data"][: r["length"]].tolist()) for r in expected
    ]


def test_replay_keeps_recorded_timing(tracked, monkeypatch):
    recording = read_recording(tracked)
    frames = next(iter(recording.frames.values())).copy()
    frames["time_ns"] += 1_700_000_000_000_000_000
    monkeypatch.setattr(
        running, "read_recording", lambda _: replace(recording, frames={"test": frames})
    )
    # A clock that waiting alone moves: what else this machine does cannot decide.
    now_s, sent = [0.0], []
    link = SimpleNamespace(
        take=lambda timeout_s: now_s.append(now_s[-1] + timeout_s + 1e-9),
        send=lambda can_id, data: sent.append((now_s[-1], can_id)),
        close=lambda: None,
    )
    monkeypatch.setattr(running, "open_link", lambda *_, **__: link)
    monkeypatch.setattr(running, "time", SimpleNamespace(monotonic=lambda: now_s[-1]))
    assert replay(tracked, bus_file(), Stop(), speed=4.0) == len(sent)
    syncs_s = np.array([at_s for at_s, can_id in sent if can_id == 0x80])
    recorded_ns = frames["time_ns"][frames["can_id"] == 0x80]
    assert syncs_s[0] < 5.0
    np.testing.assert_allclose(
        syncs_s - syncs_s[0], (recorded_ns - recorded_ns[0]) / 4e9, atol=1e-5
    )


def test_replay_stops_at_first_foreign_frame(tracked, monkeypatch):
    sent: list[tuple[int, bytes]] = []

    def take(timeout_s: float) -> Frame | None:
        time.sleep(timeout_s)
        return Frame(0, 0x701, b"\0") if len(sent) == 20 else None

    link = SimpleNamespace(take=take, send=lambda *frame: sent.append(frame), close=lambda: None)
    monkeypatch.setattr(running, "open_link", lambda *_, **__: link)
    with pytest.raises(RefusedError) as caught:
        replay(tracked, bus_file(), Stop(), speed=1000.0)
    assert len(sent) == 20
    assert caught.value.why.endswith("; 20 frames were sent")


def test_replay_onto_hardware_needs_option(tracked):
    with pytest.raises(RefusedError) as caught:
        replay(tracked, bus_file("nowhere0", "socketcan"), Stop())
    assert (caught.value.key, caught.value.value) == ("interface", "socketcan")
    with pytest.raises(BusFaultError, match="nowhere0: the bus cannot be opened"):
        replay(tracked, bus_file("nowhere0", "socketcan"), Stop(), onto_bus=True)


def neighbour(can_id: int) -> partial:
    return partial(Unasked, frames=[Frame(1_300_000_000, can_id, b"\x05")])


def other_device(can_id: int = 0x185) -> partial:
    """Node 5, a gripper, sends all that a device sends by itself, every 20 ms, throughout;
    `can_id` is that of its PDO.
    """
    own = itertools.cycle(
        [(0x705, b"\x05"), (0x705, b"\0"), (0x085, bytes(8)), (can_id, b"\x01\x02")]
    )
    return partial(
        Unasked, frames=[Frame(1_010_000_000 + k * 20_000_000, *next(own)) for k in range(500)]
    )


def test_heartbeat_of_listed_device_is_accepted(tmp_path):
    robot = robot_of(bus_text(2, extra="other_nodes = [5]"))
    session = dry_session(tmp_path / "a.mcap", TASKS[1], robot=robot, through=other_device())
    assert session.outcome.reason == "finished"
    run, _ = connected(robot)
    assert not findings(other_device()(link=run), run.drives.bus, "other nodes")


@pytest.mark.parametrize("task", TASKS)
def test_unlisted_device_is_refused(tmp_path, task):
    session = dry_session(tmp_path / "a.mcap", task, through=other_device())
    error = session.outcome.error
    assert (error.place, error.key, error.value) == ("bus", "other_nodes", ())
    assert "other_nodes = [5]" in error.advice
    assert "master is active" not in error.why
    assert len(session.sent) == 0
    session = dry_session(tmp_path / "b.mcap", task, through=other_device(0x602))
    assert (
        session.outcome.error.why
        == "another master is active (SDO request to node 2), so nothing was sent"
    )


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("can_id", [0x000, 0x080, 0x201, 0x605, 0x77F])
def test_session_beside_other_master_sends_nothing(tmp_path, task, can_id):
    session = dry_session(tmp_path / "a.mcap", task, through=neighbour(can_id))
    assert session.outcome.fault
    assert service_of(Frame(0, can_id, b""), 0x80) in session.outcome.reason
    assert "record --passive" in session.outcome.reason
    assert len(session.sent) == 0
    assert session.events("disabled") + session.events("not disabled") == []


@pytest.mark.parametrize("task", TASKS)
def test_enabled_drive_without_master_is_untouched(tmp_path, task):
    def enabled(frame: Frame) -> Frame:
        # 6041h: operation enabled
        data = frame.data[:4] + b"\x37\x02\0\0" if frame.can_id == 0x581 else frame.data
        return frame._replace(data=data)

    session = dry_session(tmp_path / "a.mcap", task, through=partial(Edited, edit=enabled))
    assert session.outcome.error.place == "node 1"
    assert session.outcome.reason.startswith("node 1: the drive is in operation enabled")
    assert "`robot-acquire disable ROBOT.toml`" in session.outcome.reason
    assert session.sent["can_id"].tolist() == [0x601]
    assert session.sent["data"].tolist() == [[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]]
    assert not any(node.operational for node in session.drives.nodes)
    assert session.events("disabled") + session.events("not disabled") == []


INTRUDERS = [
    (0x000, 0, "NMT command"),
    (0x202, 0, "RPDO 1 to node 2"),
    (0x202, SENT, "RPDO 1 to node 2"),  # of another program of this machine
    (0x601, 0, "SDO request to node 1"),
]
STRANGERS = {(0x605, 0): "SDO request to node 5", (0x303, 0): "RPDO 2 to node 3",
             (0x182, REMOTE_REQUEST): "remote request for TPDO 1 of node 2"}  # fmt: skip
LONG = Task(reference=np.zeros((301, 2)))
INTRUDED_NS = 2_300_000_000  # the session tracks its reference then


def intruder(*frames: tuple[int, int]) -> partial:
    times = range(INTRUDED_NS, INTRUDED_NS + 50_000_000, 3_000_000)
    return partial(
        Unasked,
        frames=[Frame(t, i, b"\x01\x03\0\0\0\0\0\0", flags) for t in times for i, flags in frames],
    )


@pytest.mark.parametrize(("can_id", "flags", "service"), INTRUDERS)
def test_other_master_in_motion_is_fault(tmp_path, can_id, flags, service):
    session = dry_session(tmp_path / "a.mcap", LONG, through=intruder((can_id, flags)))
    (event,) = [e for e in session.recording.events if "another master is active" in e.text]
    assert event.text == f"bus: another master is active ({service}). Stop it before a motion."
    assert event.kind == "fault"
    assert session.outcome.fault
    assert 0 <= event.stamp_ns - INTRUDED_NS <= 2 * 2_000_000
    assert session.events("phase")[-1] == "track"


@pytest.mark.parametrize(
    ("task", "frames"),
    [(LONG, STRANGERS), (Task(duration_s=1.0), {(0x202, 0): "RPDO 1 to node 2"})],
)
def test_harmless_master_frames_warn_once_each(tmp_path, task, frames):
    session = dry_session(tmp_path / "a.mcap", task, through=intruder(*frames))
    assert session.outcome.reason == "finished"
    warned = [
        e for e in session.recording.events if e.kind == "warning" and "another master" in e.text
    ]
    assert [e.text.partition("(")[2].partition(")")[0] for e in warned] == list(frames.values())
    assert all(0 <= e.stamp_ns - INTRUDED_NS <= 2 * 2_000_000 for e in warned)


@pytest.mark.parametrize("can_id", [0x080, 0x202])
def test_watchdog_frames_are_not_other_master(tmp_path, can_id):
    class Stopped(InlineLog):
        def poll(self, stamp_ns):
            if stamp_ns >= INTRUDED_NS:
                raise RobotIdimError("the recorder's process stopped the drives")
            return super().poll(stamp_ns)

    session = dry_session(tmp_path / "a.mcap", LONG, through=intruder((can_id, 0)), log_of=Stopped)
    assert session.outcome.reason == "the recorder's process stopped the drives"


def test_check_beside_other_master_sends_nothing():
    sent: list[Frame] = []
    run = LockStepLink(
        SimulatedDrives(ROBOT, BUS),
        tap=lambda frame: sent.append(frame) if frame.flags & SENT else None,
    )
    alone = findings(neighbour(0x181)(link=run), BUS)
    assert sum("switch on disabled" in finding.found for finding in alone) == 2
    sent.clear()
    (found,) = findings(Unasked(link=run, frames=[Frame(run.now_ns(), 0x602, b"\x05")]), BUS)
    assert (found.subject, found.ok) == ("other nodes", False)
    assert found.found.startswith("bus: another master is active (SDO request to node 2)")
    assert "SYNC are not checked" in found.found
    assert sent == []
