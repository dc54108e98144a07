"""What a session must not be led into: stale frames, other masters, clocks,
signals, recorders that hang.
"""

import os
import signal
import struct
import time
from functools import partial

import numpy as np
import pytest
from conftest import needs_data
from dry_sessions import Answering, At, Unasked, connected, dry_session, findings, swing
from made_up_buses import bus_of, bus_text, robot_of

import acquisition.session.logs as recorder_logs
from acquisition.bus import Frame, Master, configure, read_needs
from acquisition.errors import BadInputError, BusFaultError, NoAnswerError, RobotIdimError
from acquisition.protocol import State
from acquisition.robot import axis_of
from acquisition.session import Stop, Task, stop_on_signals

TRACK = Task(reference=swing(2, seconds=0.5, amplitude=0.1))


def test_old_positions_command_nothing(tmp_path):
    """PDOs of an earlier session are still in the queue: enabled, and far from
    where the drives stand.
    """
    stale = [Frame(0, 0x181 + k % 2, struct.pack("<Hih", 0x0237, 300_000, 0)) for k in range(4)]
    session = dry_session(tmp_path / "a.mcap", TRACK, through=partial(Unasked, frames=stale))
    assert session.outcome.reason == "finished"
    first = session.sent[session.sent["can_id"] == 0x201][0]
    control, target = struct.unpack("<Hi", first["data"].tobytes()[:6])
    assert control == 0x06  # shutdown, the first step up, not enable operation
    assert abs(target) < 10
    assert np.ptp(session.recording.samples["position"], axis=0) == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("task", [TRACK, Task(duration_s=1.0)])
def test_stop_before_start(tmp_path, task):
    session = dry_session(tmp_path / "a.mcap", task, stop=Stop(reason="stopped by SIGTERM"))
    assert session.raised is None
    assert (session.outcome.reason, session.outcome.fault) == ("stopped by SIGTERM", False)


def test_check_shows_drive_values_on_its_scale():
    eds = needs_data("eds", "nanotec_CL4-E-2-12.eds")
    text = bus_text(1, drive='dictionary = "drive.eds"').replace(
        'reference = "6074"', 'actual = "6077"'
    )
    run, master = connected(robot_of(text, {"dictionary:drive.eds": eds.read_bytes()}))
    (scale,) = findings(run, master.bus, "scale")
    assert scale.found.startswith(
        "encoder increments per turns 608F 2000/1, gear 6091 1/1, feed 6092 1/1"
    )
    assert "robot.toml: 65536 counts per turn" in scale.found


def test_second_axis_uses_its_own_objects(monkeypatch):
    """All its objects of CiA 402 are 800h higher: its period 60C2h, its
    mode 6060h and 6061h too.
    """
    axis = 'control = "6840"\nstatus = "6841"\nobjects = { "6840" = "U16", "6841" = "U16" }'
    bus, link, written, read = bus_of(robot_of(bus_text(1, drive=axis))), Answering(), [], []
    assert axis_of(bus.drives[0]) == 0x800
    with pytest.raises(NoAnswerError, match="object 6841:0"):
        Master(link, bus).state(bus.drives[0])
    assert link.sent == [(0x601, bytes.fromhex("4041680000000000"))]
    mixed = bus_of(robot_of(bus_text(1, drive=axis.replace('status = "6841"', 'status = "6041"'))))
    with pytest.raises(BadInputError, match="do not belong to one axis"):
        axis_of(mixed.drives[0])
    monkeypatch.setattr(
        Master, "write", lambda self, node, index, sub, *_: written.append((index, sub))
    )
    # Heartbeat and rated value are right, and the display shows mode 8 at once.
    answers = {0x1017: 100, 0x6076: 420, 0x6861: 8}
    monkeypatch.setattr(
        Master, "read", lambda self, node, index, sub=0: read.append(index) or answers.get(index, 0)
    )
    configure(master := Master(link, bus), read_needs(master, track=True), track=True)
    assert written[-3:] == [(0x68C2, 1), (0x68C2, 2), (0x6860, 0)]
    first_axis = {index for index in read if 0x6000 <= index < 0x6800}
    assert first_axis == {0x6076}  # the rated value, which robot.toml states by this index
    asked = {0x6860, 0x6861, 0x68C2, 0x687C, 0x687D, 0x6880, 0x6891, 0x685A, 0x6885, 0x6884}
    assert {index for index in read if index >= 0x6800} == {*asked, 0x68A9, 0x68AA}


def test_starting_drive_misses_no_sync():
    master = Master(Answering(), bus_of(robot_of(bus_text(1, extra='sync_producer = "other"'))))
    master.start()
    for _ in range(10):
        master.dispatch(Frame(0, 0x80, b""))
    assert master.nodes[0].silent_syncs == 0
    master.dispatch(Frame(0, 0x701, b"\x05"))
    for _ in range(3):
        master.dispatch(Frame(0, 0x80, b""))
    assert master.nodes[0].silent_syncs == 3


def test_slow_stop_keeps_acceleration_limit(tmp_path):
    limit = np.radians(60)
    text = bus_text(1, period_s=0.004).replace(
        "acceleration_deg_s2 = 4000", "acceleration_deg_s2 = 60"
    )
    # wide enough for a path from the middle on
    robot = robot_of(text.replace("[-150, 150]", "[-200, 200]"))
    t = np.arange(0, 6, 0.004)
    # 0.5 rad/s², up to 1 rad/s and down again: far more than 0.5 s is needed to come to rest.
    speed = np.interp(t, [0, 0.5, 2.5, 3.5, 5.5, 6], [0, 0, 1.0, 1.0, 0, 0])
    reference = np.cumsum(speed)[:, None] * 0.004
    stop = Stop()
    # Tracking, at full speed.
    interrupt = partial(
        At, at_ns=4_800_000_000, act=lambda: setattr(stop, "reason", "stopped by SIGINT")
    )
    session = dry_session(
        tmp_path / "a.mcap", Task(reference=reference), robot=robot, through=interrupt, stop=stop
    )
    assert (session.outcome.reason, session.outcome.fault) == ("stopped by SIGINT", False)
    targets = session.recording.samples["reference"][:, 0]
    tracked = targets[session.recording.samples["stamp_ns"] > session.phases["track"]]
    assert np.abs(np.diff(tracked)).max() / 0.004 > 0.9
    # Targets are whole counts: a second difference of 25 samples takes their rounding out.
    smooth = (tracked[50:] - 2 * tracked[25:-25] + tracked[:-50]) / 0.1**2
    assert np.abs(smooth).max() < 1.5 * limit


@pytest.mark.parametrize(
    ("number", "handler", "asks"),
    [
        *(
            (number, signal.SIG_DFL, True)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
        ),
        # as a shell without job control starts a job in the background
        (signal.SIGINT, signal.SIG_IGN, True),
        (signal.SIGHUP, signal.SIG_IGN, False),  # as `nohup` does
    ],
)
def test_signals_request_stop(number, handler, asks):
    before, stop = signal.signal(number, handler), Stop()
    try:
        with stop_on_signals(stop):
            os.kill(os.getpid(), number)
            time.sleep(0.01)
    finally:
        signal.signal(number, before)
    assert stop.reason == (f"stopped by {number.name}" if asks else "")


def test_hanging_recorder_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_logs, "MAX_SILENT_S", 1.0)
    monkeypatch.setattr(recorder_logs, "MAX_HUNG_FINISH_S", 0.5)
    log = recorder_logs.ProcessLog(
        tmp_path / "a.mcap", robot_of(bus_text(1)), "robot.toml", recorder_logs.Role.FED
    )
    until_s = time.monotonic() + 60
    while log.poll(time.time_ns()) is None:  # it lives
        assert time.monotonic() < until_s
        time.sleep(0.05)

    def poll() -> None:
        while time.monotonic() < until_s + 60:
            time.sleep(0.05)
            log.poll(time.time_ns())

    os.kill(log._process.pid, signal.SIGSTOP)
    try:
        with pytest.raises(RobotIdimError, match="the recorder has sent no status for"):
            poll()
        with pytest.raises(BusFaultError, match=r"the recorder did not report '.*' within 0.5 s"):
            log.finish(time.time_ns())
    finally:
        os.kill(log._process.pid, signal.SIGCONT)
        log.close()


def test_old_statusword_is_ignored():
    _, master = connected()
    master.dispatch(Frame(0, 0x181, bytes.fromhex("3702e8030000") + bytes(2)))
    assert (master.nodes[0].state, master.nodes[0].counts) == (State.OPERATION_ENABLED, 1000)
    master.start()
    assert (master.nodes[0].state, master.nodes[0].counts) == (None, None)
