"""The one stop: when voltage goes off at each drive, by measured speed, and which
drives count as disabled.
"""

from collections.abc import Callable

import numpy as np
import pytest
from dry_sessions import FaultyDrives, Moved, SlowAnswers, SyncOfAnother, Through, enable, say
from made_up_buses import bus_of, bus_text, robot_of

import acquisition.bus.stopping as stopping
from acquisition.bus import Master, safe_stop, stop_drives
from acquisition.errors import HeldBack, RobotIdimError
from acquisition.protocol import State
from acquisition.simulated import DrivenPlant, LockStepLink, SimulatedDrives, cascaded_loops

SPEED = 2.0  # rad/s of joint 1 when the stop begins; the limits are 200 °/s and 4000 °/s²
LIMIT = np.deg2rad(4000)
CAP_S = 0.5 + 1.2 * SPEED / LIMIT  # the simulated drives' ramp is the acceleration limit


class Coasting(Moved):
    """Joint 1 turns at SPEED until it is held, then as `after` says (s since then, to the share of
    SPEED); joint 2 stands.
    """

    def __init__(self, after: Callable[[float], float]) -> None:
        self.after, self.held_s = after, 0.0

    def step(self, effort, held, duration_s):
        share = self.after(self.held_s) if held[0] else 1.0
        self.held_s += duration_s if held[0] else 0.0
        self.q = self.q + np.array([SPEED * share * duration_s, 0.0])


def moving(
    after: Callable[[float], float],
    *,
    started: bool = True,
    ramp: dict[int, int] | None = None,
    simulated: type[SimulatedDrives] = FaultyDrives,
    extra: str = "",
) -> tuple[LockStepLink, Master, list[tuple[int, int, bytes]]]:
    robot = robot_of(bus_text(2, extra=extra))
    bus, sent = bus_of(robot), list[tuple[int, int, bytes]]()
    mechanism = DrivenPlant(plant=Coasting(after), loops=cascaded_loops(robot, np.ones(2)))
    run = LockStepLink(
        simulated(robot, bus, mechanism, supervised=False),
        tap=lambda f: sent.append((f.time_ns, f.can_id, f.data)),
    )
    for node in run.drives.nodes:
        node.values |= {(index, 0): value for index, value in (ramp or {}).items()}
    master = Master(run, bus)
    enable(master, start=started)
    for _ in range(20):
        master.sync()
        master.wait(run.now_ns() + 2_000_000)
    assert run.drives.states == [State.OPERATION_ENABLED] * 2
    sent.clear()
    return run, master, sent


def off_s(sent: list[tuple[int, int, bytes]], node: int) -> float:
    """From the first quick stop to the first disable voltage by PDO:
    controlwords 0002h and 0000h.
    """
    words = [(t, data[:2]) for t, can_id, data in sent if can_id == 0x200 + node]
    assert words[0][1] == b"\x02\x00"
    return (next(t for t, word in words if word == b"\x00\x00") - words[0][0]) * 1e-9


COUNTS = 50 * 65536 / (2 * np.pi)  # per rad of a joint
ONE_RAD_S2 = {0x6085: round(COUNTS)}
TWO_RAD_S2 = {0x605A: 5, 0x6084: round(2 * COUNTS)}


def halved(t: float) -> float:
    return max(0.5, 1 - 3 * t)


def slowly(t: float) -> float:
    return max(0.0, 1 - 0.5 * t)


@pytest.mark.parametrize(
    ("after", "how", "at_s", "within_s"),
    [
        (lambda t: 0.0, {}, 0.02, 0.012),
        (lambda t: max(0.0, 1 - t / 0.2), {}, 0.2, 0.02),  # until it stands, and not before
        (lambda t: 1.0, {}, 0.05, 0.006),  # the quick stop does not work
        (lambda t: 1.0 + t, {}, 0.05, 0.006),
        (halved, {}, CAP_S, 0.006),  # slower, but never at rest
        (halved, {"ramp": ONE_RAD_S2}, 0.5 + 1.2 * 0.985 * SPEED, 0.02),
        (halved, {"ramp": TWO_RAD_S2}, 0.5 + 1.2 * SPEED / 2.0, 0.02),
        (halved, {"ramp": {0x605A: 0}}, 0.5 + SPEED / LIMIT, 0.02),  # unknown
        # unknown, and too slow for that
        (lambda t: 1 - 0.5 * t, {"ramp": {0x605A: 3}}, 0.05, 0.02),
        (slowly, {"ramp": ONE_RAD_S2}, 1.98, 0.02),  # 2.5 % slower after 0.05 s
        # the ramp is still being read
        (slowly, {"ramp": ONE_RAD_S2, "simulated": SlowAnswers}, 1.98, 0.02),
        # Above the start, but it falls; it runs away at last.
        (
            lambda t: 1.0 + (t > 0.01) if t < 0.03 else max(0.0, 2 - 90 * (t - 0.03)),
            {},
            0.074,
            0.02,
        ),
        (lambda t: 1 - 0.5 * t if t < 0.3 else 1.2, {"ramp": ONE_RAD_S2}, 0.302, 0.02),
    ],
)
def test_voltage_off_at_rest_or_after_ramp_time(after, how, at_s, within_s):
    run, master, sent = moving(after, **how)
    assert safe_stop(master, HeldBack()) == []
    assert run.drives.states == [State.SWITCH_ON_DISABLED] * 2
    assert off_s(sent, 1) == pytest.approx(at_s, abs=within_s)
    if "simulated" not in how:
        # it stands, whatever the other does
        assert off_s(sent, 2) == pytest.approx(0.014, abs=0.012)


def test_stop_without_foreign_sync():
    _, master, sent = moving(lambda t: 1.0, extra='sync_producer = "other"')
    master.synced_ns = None  # it was not ours
    safe_stop(master, HeldBack())
    assert off_s(sent, 1) == pytest.approx(0.5 + 1.2 * np.deg2rad(200) / LIMIT, abs=0.03)


def test_drive_without_position_gets_its_ramp_time():
    def silence(t: float) -> float:
        if t > 0.024:
            run.drives.silent.add(0)
        return 1.0

    run, master, sent = moving(silence)
    assert safe_stop(master, HeldBack()) == [1]
    assert off_s(sent, 1) == pytest.approx(CAP_S, abs=0.03)


def test_quick_stop_goes_to_all_by_pdo_and_sdo():
    _, master, sent = moving(lambda t: 0.0)
    safe_stop(master, HeldBack())
    first_ns = sent[0][0]
    at_once = {(can_id, data) for t, can_id, data in sent if t == first_ns}
    quick = bytes.fromhex("2b40600002000000")  # two bytes to 6040h:0
    assert {(0x601, quick), (0x602, quick)} <= at_once
    assert {can_id for can_id, data in at_once if data[:2] == b"\x02\x00"} >= {0x201, 0x202}


def test_drive_deaf_to_pdo_is_stopped_by_sdo():
    run, master, sent = moving(lambda t: 0.0, started=False)
    assert safe_stop(master, HeldBack()) == []
    assert run.drives.states == [State.SWITCH_ON_DISABLED] * 2
    # no position was heard: no target is made up
    assert not any(can_id in (0x201, 0x202) for _, can_id, _ in sent)


def test_silent_drive_is_named_and_delays_none():
    run, master, sent = moving(lambda t: 1.0)
    run.drives.silent.add(1)
    began_ns = run.now_ns()
    assert safe_stop(master, HeldBack()) == [2]
    assert run.drives.states[0] is State.SWITCH_ON_DISABLED
    assert off_s(sent, 1) == pytest.approx(0.05, abs=0.006)
    assert (run.now_ns() - began_ns) * 1e-9 < CAP_S + 1.2


@pytest.mark.parametrize(("by_ms", "steps_ms"), [(30, [2, 32, 2, 2]), (1, [2, 3, 1, 2])])
def test_late_stop_sync_causes_no_burst(by_ms, steps_ms):
    """No burst follows a stall; one late by less than a period moves no later one."""
    run, master, sent = moving(lambda t: max(0.0, 1 - t / 0.2))

    class Late(Through):
        late_ns = by_ms * 1_000_000

        def receive(self, until_ns):
            frame = super().receive(until_ns)
            # the next SYNC is due
            if frame is None and len([1 for _, can_id, _ in sent if can_id == 0x80]) == 20:
                self.link._time_ns, self.late_ns = self.now_ns() + self.late_ns, 0
            return frame

    master.link = Late(link=run)
    assert safe_stop(master, HeldBack()) == []
    steps = np.diff([t for t, can_id, _ in sent if can_id == 0x80])
    assert (steps[18:22] // 1_000_000).tolist() == steps_ms
    assert steps.min() >= 1_000_000


def test_stop_commands_go_on_while_sync_fails():
    run, master, sent = moving(lambda t: 1.0)
    again_ns = run.now_ns() + 80_000_000

    class NoSync(Through):
        def send(self, can_id, data):
            if can_id == 0x80 and self.now_ns() < again_ns:
                raise RobotIdimError("bus: frame cannot be sent: transmit buffer full")
            super().send(can_id, data)

    master.link = NoSync(link=run)
    assert safe_stop(master, HeldBack()) == []
    assert run.drives.states == [State.SWITCH_ON_DISABLED] * 2
    orders_ns = np.unique([t for t, can_id, _ in sent if can_id == 0x201])
    assert len(orders_ns) > 40
    assert set(np.diff(orders_ns)) == {2_000_000}


def test_stop_commands_follow_foreign_sync():
    run, master, sent = moving(lambda t: max(0.0, 1 - t / 0.2), extra='sync_producer = "other"')
    master.link = SyncOfAnother(link=run, next_ns=run.now_ns() + 2_000_000)
    assert safe_stop(master, HeldBack()) == []
    words = [can_id for _, can_id, _ in sent if can_id in (0x80, 0x201)]
    assert len(words) > 100
    assert words[:100] == [0x201, 0x80] * 50


def test_voltage_off_follows_confirmation():
    run, master, sent = moving(lambda t: max(0.0, 1 - t / 0.2))
    run.drives.nodes[0].state = State.SWITCH_ON_DISABLED  # by its own reaction, at speed
    assert safe_stop(master, HeldBack()) == []
    assert off_s(sent, 1) < 0.045  # earlier than any judgement of its speed


def test_fault_is_disabled_and_switched_on_is_not(monkeypatch):
    run, master, _ = moving(lambda t: 0.0)
    with monkeypatch.context() as patch:
        say(patch, lambda node, word: 0x0233 if node == 2 else 0x0250)
        assert safe_stop(master, HeldBack()) == [2]
    say(monkeypatch, lambda node, word: 0x0218)
    assert safe_stop(master, HeldBack()) == []

    def refuse(*_):
        raise RobotIdimError("bus: gone")

    monkeypatch.setattr(run, "send", refuse)
    monkeypatch.setattr(run, "receive", refuse)
    assert safe_stop(master, HeldBack()) == [1, 2]


def test_no_pdo_enables_after_disable_or_watchdog(monkeypatch):
    run, master, _ = moving(lambda t: 0.0)
    monkeypatch.setattr(stopping, "open_link", lambda *_, **__: run)
    monkeypatch.setattr(run, "close", lambda: None, raising=False)
    assert stop_drives(master.bus) == []
    master.wait(run.now_ns() + 1_000_000)
    assert [node.nmt for node in run.drives.nodes] == [127, 127]
    for word in (0x06, 0x07, 0x0F):
        for node in (1, 2):
            run.send(0x200 + node, word.to_bytes(2, "little") + bytes(4))
        master.sync()
        master.wait(run.now_ns() + 2_000_000)
    assert run.drives.states == [State.SWITCH_ON_DISABLED] * 2
