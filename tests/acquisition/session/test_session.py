"""Sessions on simulated drives: what they record, and that whatever goes wrong
every drive ends disabled.
"""

import itertools
import pkgutil
import shutil
from collections import namedtuple
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from dry_sessions import (
    At,
    Edited,
    Fault,
    FaultyDrives,
    SyncOfAnother,
    Through,
    Unasked,
    dry_session,
    swing,
)
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.bus import Frame
from acquisition.errors import RobotIdimError
from acquisition.protocol import State
from acquisition.recording import ERROR, SENT
from acquisition.session import Stop, Task

LISTENED_NS = 1_500_000_000  # simulated time begins at 1 s; half a second of listening
PATH = swing(2, seconds=0.5, amplitude=0.1)
TRACK = Task(reference=PATH)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return dry_session(tmp_path_factory.mktemp("finished") / "a.mcap", TRACK)


def tracked(session) -> np.ndarray:
    samples, at = session.recording.samples, session.phases
    return samples[(samples["stamp_ns"] >= at["track"]) & (samples["stamp_ns"] < at["stop"])]


def test_reference_is_tracked_and_recorded(finished):
    session = finished
    assert (session.outcome.reason, session.outcome.fault, session.outcome.alarm) == (
        "finished",
        False,
        "",
    )
    assert session.drives.states == [State.SWITCH_ON_DISABLED] * 2
    assert session.events("phase") == [
        "configure",
        "enable",
        "approach",
        "track",
        "stop",
        "disable",
    ]
    assert session.events("end") == ["finished"]
    assert session.events("disabled") == ["every drive confirmed"]
    assert session.recorded.warnings == ()
    samples, at = tracked(session), session.phases
    assert samples["reference"] == pytest.approx(PATH, abs=2e-6)
    assert np.abs(samples["position"] - samples["reference"]).max() < 0.01
    assert (np.diff(session.recording.samples["stamp_ns"]) == 2_000_000).all()
    frames = session.frames
    assert 0.4 < np.mean(frames["flags"] & SENT != 0) < 0.6
    nmt = frames[frames["can_id"] == 0]  # to our drives only
    assert nmt["length"].tolist() == [2] * len(nmt)
    assert nmt["data"][:, :2].tolist() == [[128, 1], [128, 2], [1, 1], [1, 2], [128, 1], [128, 2]]
    plan = session.events("plan")[1]
    assert float(plan.split()[1]) == pytest.approx((at["stop"] - at["track"]) * 1e-9, abs=0.01)


def test_no_motion_without_reference(tmp_path):
    session = dry_session(tmp_path / "a.mcap", Task(duration_s=0.5))
    assert session.events("phase") == ["configure", "record"]
    assert not (session.frames["can_id"] == 0x77F).any()  # a master's heartbeat
    assert np.ptp(session.recording.samples["position"]) == 0
    sent = session.sent
    assert not np.isin(sent["can_id"], [0x201, 0x202]).any()
    sdo = sent[(sent["can_id"] > 0x600) & (sent["can_id"] < 0x680)]
    assert not (
        (sdo["data"][:, 1] == 0x40) & (sdo["data"][:, 2] == 0x60) & (sdo["data"][:, 0] != 0x40)
    ).any()
    assert len(session.recording.samples) == pytest.approx(250, abs=3)


@pytest.mark.parametrize(
    ("kinds", "counted"),
    [
        ({"late": 1}, {"late": 1}),
        ({"duplicate": 1}, {"duplicate": 1}),
        ({"missing": 2, "short": 1}, {"missing": 3, "short": 1}),  # a short one is missing too
    ],
)
def test_bad_pdos_are_counted(tmp_path, kinds, counted):
    faults = [
        Fault(kind=kind, node=1, sync=200 + 60 * k, count=kinds[kind])
        for k, kind in enumerate(kinds)
    ]
    session = dry_session(tmp_path / "a.mcap", TRACK, faults=faults)
    assert session.outcome.reason == "finished"
    counters = session.recording.health[-1].counters
    assert {kind: counters[kind] for kind in counted} == counted
    assert all(
        any(f"{count} {kind}" in text for text in session.recorded.warnings)
        for kind, count in counted.items()
    )
    gaps = int((np.diff(session.recording.samples["stamp_ns"]) != 2_000_000).sum())
    assert gaps == len(kinds.keys() - {"late"})  # the rows about it, whose order nothing proves


@dataclass(kw_only=True)
class DeadBus(Through):
    ends: int
    count: int = 0

    def send(self, can_id, data):
        self.count += 1
        if 800 <= self.count < self.ends:
            raise RobotIdimError("bus: frame cannot be sent: transmit buffer full")
        super().send(can_id, data)


def test_dead_bus_confirms_nothing(tmp_path):
    session = dry_session(tmp_path / "a.mcap", TRACK, through=partial(DeadBus, ends=10**9))
    assert "transmit buffer full" in session.outcome.reason
    assert session.outcome.unconfirmed == (1, 2)


NOT_OPERATIONAL = {"data": b"\x7f"}
ERROR_FRAME = {"can_id": 0x28, "flags": ERROR, "data": b"\0\0\0\x19"}
NO_ACKNOWLEDGEMENT = (
    "in acknowledgement; no acknowledgement: no other node receives, or the cable is open"
)


def of(*faults: Fault) -> dict[str, object]:
    return {"faults": faults}


def beats(node: int, which: range, other: dict[str, object] | None) -> dict[str, object]:
    """Of the heartbeats of a node that say operational, those in `which`, from 1, are
    other frames, or are lost.
    """
    count = itertools.count(1)

    def edit(frame: Frame) -> Frame | None:
        if (frame.can_id, frame.data) != (0x700 + node, b"\x05") or next(count) not in which:
            return frame
        return None if other is None else frame._replace(**other)

    return {"through": partial(Edited, edit=edit)}


def disobedient(bit: int) -> dict[str, object]:
    return of(
        *(
            Fault(kind="clear", node=2, sync=sync, count=count, bits=bit)
            for sync, count in ((60, 2), (90, 3))
        )
    )


OTHER = {"robot": robot_of(bus_text(2, extra='sync_producer = "other"')), "through": SyncOfAnother}
ENDED = {"through": partial(SyncOfAnother, ends_ns=2_200_000_000)}


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        (of(Fault(kind="short", node=1, sync=250, count=3)),
         "node 1 (motor_1): the drive has not answered 3 SYNCs in a row"),
        (beats(2, range(1, 10**9), NOT_OPERATIONAL),
         "node 2 (motor_2): the drive is not operational 3 heartbeats after START (NMT state 127)"),
        (beats(1, range(4, 5), NOT_OPERATIONAL), "node 1 (motor_1): the drive has left "
                                                 "operational (NMT state 127)"),
        (beats(1, range(2, 5), None),
         "node 1 (motor_1): the drive has sent no heartbeat for 0.30 s"),
        (beats(1, range(4, 5), ERROR_FRAME), f"bus: error frame: protocol: {NO_ACKNOWLEDGEMENT}"),
        (disobedient(0x0200),
         "node 2 (motor_2): the drive does not accept commands from the bus (statusword bit 9, "
         "remote, is 0) for 3 SYNC periods"),
        (disobedient(0x1000), "node 2 (motor_2): the drive does not follow its target "
                              "(statusword bit 12 is 0) for 3 SYNC periods"),
        ({"through": partial(Unasked, frames=[Frame(1_600_000_000, 0x80, b"")])},
         "bus: another producer sends SYNC"),
        (OTHER | ENDED, "bus: no SYNC was received in 10 periods. Start the other SYNC "
                        "producer, or set sync_producer = 'recorder'."),
        (OTHER | of(Fault(kind="missing", node=1, sync=300, count=4)),
         "node 1 (motor_1): the drive has not answered 3 SYNCs in a row"),
        ({"through": partial(DeadBus, ends=803)},
         "bus: frame cannot be sent: transmit buffer full"),
    ],
)  # fmt: skip
def test_every_end_leaves_drives_disabled(tmp_path, what, reason):
    session = dry_session(tmp_path / "a.mcap", TRACK, **what)
    assert (session.outcome.reason, session.outcome.fault) == (reason, True)
    assert session.events("fault") == [reason]
    assert session.events("disabled") == ["every drive confirmed"]
    assert not session.recording.cut


def test_one_lost_heartbeat_is_accepted(tmp_path):
    stale, lost = beats(2, range(1, 3), NOT_OPERATIONAL), beats(1, range(2, 3), None)
    session = dry_session(
        tmp_path / "a.mcap",
        TRACK,
        through=lambda link: lost["through"](link=stale["through"](link=link)),
    )
    assert session.outcome.reason == "finished"


@pytest.mark.parametrize("task", [TRACK, Task(duration_s=1.0)])
def test_nearly_full_disk_ends_session(tmp_path, monkeypatch, task):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(1, 1, 0))
    session = dry_session(tmp_path / "a.mcap", task)
    assert (session.outcome.reason, session.outcome.fault) == ("the disk is nearly full", False)
    assert session.outcome.cut_short
    assert session.recorded.samples > 0


@pytest.mark.parametrize("at", [0.028, 0.05, 0.3, 0.6])
def test_requested_stop_is_slow(tmp_path, at):
    stop = Stop()
    interrupt = partial(
        At, at_ns=LISTENED_NS + at * 1e9, act=lambda: setattr(stop, "reason", "stopped by SIGINT")
    )
    session = dry_session(tmp_path / "a.mcap", TRACK, through=interrupt, stop=stop)
    assert (session.outcome.reason, session.outcome.fault) == ("stopped by SIGINT", False)
    assert session.drives.states == [State.SWITCH_ON_DISABLED] * 2
    q = session.recording.samples["position"]
    assert np.abs(np.diff(q, 2, axis=0)).max() / 0.002**2 < 70  # rad/s²: the stated limit
    assert np.ptp(q[-20:]) < 1e-3


@pytest.mark.parametrize(
    ("method", "error"),
    [("_enable", RuntimeError("boom")), ("_follow", KeyboardInterrupt()), ("_hold", SystemExit(3)),
     ("_disable", RuntimeError("boom")), ("_positions", KeyboardInterrupt())],
)  # fmt: skip
def test_exception_in_any_phase(tmp_path, monkeypatch, method, error):
    place = f"acquisition.session.session._Session.{method}"
    real = pkgutil.resolve_name(place)

    def broken(self, *arguments):
        for k, order in enumerate(real(self, *arguments)):
            if k == 3:
                raise error
            yield order

    if method == "_positions":  # it gives no orders

        def broken(self, *arguments):
            raise error

    monkeypatch.setattr(place, broken)
    session = dry_session(tmp_path / "a.mcap", TRACK)
    assert session.raised is error
    assert session.events("fault")[0].startswith(type(error).__name__)
    assert session.events("disabled") == ["every drive confirmed"]


@pytest.mark.parametrize(
    ("change", "task", "expected", "disabled"),
    [
        # Nothing was written to these drives, so that nobody confirms anything.
        *((("= 0.42", "= 0.5"), task,
           "node 2 (motor_2): rated value 6076:0: 420, but robot.toml gives 500", [])
          for task in (Task(duration_s=1.0), TRACK)),
        *((("node = 2", "node = 9"), task,
           "node 9: object 6041:0: the drive did not answer within 0.3 s", [])
          for task in (Task(duration_s=1.0), TRACK)),
        (("node = 1", 'tpdo = [{ objects = ["6064", "6074"] }]\nnode = 1'), TRACK,
         "node 1: no PDO from the drive carries 6041:0, which", []),
        (("node = 1", 'rpdo = [{ objects = ["6040"] }]\nnode = 1'), TRACK,
         "no PDO to the drive carries 607A:0", []),
        (("node = 1", 'rpdo = [{ objects = ["6040", "607A"] }, { objects = ["6071"] }]\nnode = 1'),
         TRACK,
         "carries 6071:0, which tracking would set to 0. Map only 6040:0, 6060:0", []),
    ],
)  # fmt: skip
def test_wrong_robot_toml_is_refused_before_start(tmp_path, change, task, expected, disabled):
    drives, other = bus_of(robot_of(bus_text(2))), robot_of(bus_text(2).replace(*change))
    session = dry_session(tmp_path / "a.mcap", task, robot=other, drives=drives)
    assert expected in session.outcome.reason
    assert session.events("disabled") + session.events("not disabled") == disabled
    assert not any(node.operational for node in session.drives.nodes)


@pytest.mark.parametrize(
    ("reference", "zero_counts", "expected"),
    [
        (swing(2, amplitude=2.0), 0, "position of joint_1 = 2.618 rad: expected -2.618 to 2.618"),
        (swing(2)[100:], 0, "acceleration of joint_1"),  # it does not begin at rest
        (swing(2), 2147480000, "counts: expected -2147483648 to 2147483647"),
    ],
)
def test_reference_beyond_limit_is_refused(tmp_path, reference, zero_counts, expected):
    robot = robot_of(bus_text(2, drive=f"zero_counts = {zero_counts}"))
    session = dry_session(
        tmp_path / "a.mcap", Task(reference=reference, place="ref.csv"), robot=robot
    )
    assert "ref.csv: at " in session.outcome.reason
    assert expected in session.outcome.reason
    assert len(session.sent) == 0
    # nothing is said of drives not addressed
    assert session.events("disabled") + session.events("not disabled") == []


def test_foreign_sync_is_followed(tmp_path):
    mapped = 'rpdo = [{ objects = ["6040", "6060", "607A"] }]'
    robot = robot_of(bus_text(2, extra='sync_producer = "other"', drive=mapped))
    session = dry_session(tmp_path / "a.mcap", TRACK, robot=robot, through=SyncOfAnother)
    assert session.outcome.reason == "finished"
    samples = tracked(session)
    assert samples["reference"][5:-5] == pytest.approx(PATH[5:-5], abs=0.01)
    assert np.ptp(samples["position"]) > 0.15


@pytest.mark.parametrize(("reads", "fault"), [(3, False), (10_000, True)])
def test_operation_mode_is_awaited(tmp_path, reads, fault):
    class Late(FaultyDrives):
        asked = 0

        def receive(self, now_ns, can_id, data):
            sent = super().receive(now_ns, can_id, data)
            if (can_id, data[:4]) != (0x602, bytes.fromhex("40616000")):
                return sent
            self.asked += 1
            return (
                sent
                if self.asked > reads
                else [(0x582, answer[:4] + bytes(4)) for _, answer in sent]
            )

    session = dry_session(tmp_path / "a.mcap", TRACK, simulated=Late)
    if fault:
        error = session.outcome.error
        assert (error.place, error.key, error.value) == ("node 2", "mode of operation (6061:0)", 0)
        assert session.events("phase") == ["configure"]
    else:
        assert session.outcome.reason == "finished"
        assert session.drives.asked == reads + 1
