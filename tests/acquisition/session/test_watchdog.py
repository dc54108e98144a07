"""The recorder's process stops the drives of a session that dies or hangs; `disable`
stops those of anybody.
"""

import itertools
import multiprocessing
import signal
import struct
import time
from contextlib import closing
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from busy_machine import SYNC_S, stalls, tried_again
from dry_sessions import DrySession, Fault, SlowAnswers, Through, connected, dry_session, enable
from made_up_buses import bus_of, bus_text, robot_of
from session_processes import (
    PATIENCE_S,
    bus_at,
    drives,
    folder,
    frames_of,
    port,
    states_of,
    texts,
    tracking,
    wait_for,
)

import acquisition.session.process as process_module
from acquisition.bus import Master, open_link
from acquisition.commands import main
from acquisition.errors import NoAnswerError
from acquisition.protocol import State, state_of
from acquisition.recording import Recording
from acquisition.session import InlineLog, Task, Watchdog, WatchdogPipe, silence_s

__all__ = ["folder", "port"]  # fixtures
LONGEST_S = 0.3 + 2 * SYNC_S  # from the last SYNC of the session to the quick stop of every drive


def states(recording: Recording, number: int) -> list[tuple[int, State]]:
    frames = frames_of(recording)
    own = frames[frames["can_id"] == 0x180 + number]
    words = own["data"][:, :2].copy().view("<u2")[:, 0]
    return [(int(t), state_of(int(word))) for t, word in zip(own["time_ns"], words, strict=True)]


def stopped_s(recording: Recording, number: int, since_ns: int) -> float:
    then = [
        t
        for t, state in states(recording, number)
        if t > since_ns and state is not State.OPERATION_ENABLED
    ]
    return (then[0] - since_ns) * 1e-9


def last_target_ns(recording: Recording) -> int:
    """When the session commanded drives for the last time, before the first quick stop."""
    frames = frames_of(recording)
    targets = frames[(frames["can_id"] == 0x201) & (frames["data"][:, 0] == 0x0F)]
    return int(targets["time_ns"][-1])


def disabled_by_the_recorder(recording: Recording) -> bool:
    """ShowStatus, and the drives' own last words on the disk too."""
    confirmed = "every drive confirmed to the watchdog" in texts(recording, "disabled")
    return confirmed and all(
        states(recording, k)[-1][1] is State.SWITCH_ON_DISABLED for k in (1, 2)
    )


@pytest.mark.parametrize(
    ("number", "silent"),
    [
        (signal.SIGKILL, "the session's process has ended"),
        (signal.SIGSTOP, "the session has sent no heartbeat for 0.3 s"),
    ],
)
@tried_again
def test_unmonitored_drives_are_stopped(folder, number, silent):
    out = folder / "log.mcap"
    with drives(folder, "--unsupervised"), stalls() as worst:
        with tracking(folder, out, "--unsupervised-drives") as session:
            session.send_signal(number)
            try:
                recording = wait_for(out, disabled_by_the_recorder)
            finally:
                session.send_signal(signal.SIGCONT)
            last_ns = last_target_ns(recording)
            for node_id in (1, 2):
                assert stopped_s(recording, node_id, last_ns) < LONGEST_S + 2 * worst[0]
            _, errors = session.communicate(timeout=PATIENCE_S)
            assert session.returncode != 0
            if number is signal.SIGSTOP:
                assert "fault" in errors
                assert "another" not in errors  # the second stop's frames are ours
        recording = wait_for(out, lambda r: not r.cut)
        assert last_target_ns(recording) == last_ns  # who wakes up enables nothing
        assert {state for t, state in states(recording, 1) if t > last_ns + 10**9} <= {
            State.SWITCH_ON_DISABLED
        }
        assert states_of(folder) == [State.SWITCH_ON_DISABLED] * 2
    assert f"{silent}: the watchdog stopped the drives" in texts(recording, "fault")
    assert len(recording.samples) > 0


def test_disable_command_disables_drives(folder, capsys):
    with drives(folder, "--unsupervised"):
        robot = robot_of((folder / "robot.toml").read_text())
        with closing(open_link(bus_at(folder), passive=False)) as link:
            master = Master(link, bus_of(robot))
            enable(master)
            master.sync()
            master.wait(link.now_ns() + 1_000_000_000, for_answers=True)
            assert [master.state(drive) for drive in master.bus.drives] == [
                State.OPERATION_ENABLED
            ] * 2
            assert main(["disable", str(folder / "robot.toml")]) == 0
            assert (
                capsys.readouterr().out
                == "disabled: nodes 1, 2, all in NMT state pre-operational\n"
            )
            master.wait(link.now_ns() + 200_000_000)  # answers to the command's own questions
            assert [master.state(drive) for drive in master.bus.drives] == [
                State.SWITCH_ON_DISABLED
            ] * 2
            link.send(0x201, struct.pack("<Hi", 6, 0))  # a PDO commands nothing any more
            master.sync()
            master.wait(link.now_ns() + 100_000_000)
            assert master.state(master.bus.drives[0]) is State.SWITCH_ON_DISABLED


def test_disable_names_unconfirmed_drives_first(folder, capsys):
    assert main(["disable", str(folder / "robot.toml")]) == 1
    assert capsys.readouterr() == ("", "NOT DISABLED: nodes 1, 2: EMERGENCY STOP\n")
    (folder / "away.toml").write_text(
        (folder / "robot.toml").read_text().replace("udp_multicast", "socketcan")
    )
    assert main(["disable", str(folder / "away.toml")]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first == "NOT DISABLED: nodes 1, 2: EMERGENCY STOP"
    assert "cannot be opened" in second


def test_watchdog_acts_only_when_armed(monkeypatch):
    bus = bus_of(robot_of(bus_text(2, channel="nobody_here")))
    for signs, acts in (("e", False), ("a", True), ("aae", False), ("aea", False)):
        here, there = multiprocessing.Pipe()
        watchdog, life = Watchdog(here, bus), WatchdogPipe(there)
        for sign in signs:
            life.alive() if sign == "a" else life.ended()
        if not acts:
            life.alive()  # what is disarmed stays so
        life.close()
        watchdog._thread.join(20)
        assert not watchdog.waiting
        assert (watchdog.reason is not None) == acts
        kinds = [kind for _, kind, _ in watchdog.events]
        assert kinds == (["fault", "not disabled"] if acts else [])
    # The session knows of the second stop before its first frame.
    here, there = multiprocessing.Pipe()
    life, said = WatchdogPipe(there), []
    monkeypatch.setattr(process_module, "stop_drives", lambda _: said.append(life.stopped()) or [])
    watchdog = Watchdog(here, bus)
    assert life.stopped() == ""
    life.alive()
    watchdog._thread.join(20)
    assert said == ["the session has sent no heartbeat for 0.3 s: the watchdog stopped the drives"]
    life.close()


class Beating(InlineLog):
    """Notes when the session shows that it runs, and when it disarms, in simulated time."""

    signs: ClassVar[list[tuple[int, str]]] = []
    link: ClassVar[Any] = None

    def poll(self, stamp_ns):
        self.alive()
        return super().poll(stamp_ns)

    def alive(self):
        self.signs.append((self.link.now_ns(), "alive"))

    def ended(self):
        self.signs.append((self.link.now_ns(), "ended"))


@dataclass(kw_only=True)
class Clocked(Through):
    def __post_init__(self):
        Beating.link = self.link
        Beating.signs.clear()


def beating_session(path, faults=()) -> DrySession:
    robot, task = robot_of(bus_text(4)), Task(reference=np.zeros((51, 4)))
    how = {"through": Clocked, "simulated": SlowAnswers, "log_of": Beating}
    return dry_session(path, task, robot=robot, faults=faults, **how)


def test_awaited_answer_keeps_heartbeats():
    (run, master), times = connected(), list[int]()
    run.drives.silent.add(0)
    began_ns = run.now_ns()
    master.while_awaiting = lambda: times.append(run.now_ns() - began_ns)
    with pytest.raises(NoAnswerError, match=r"the drive did not answer within 0.3 s"):
        master.read(1, 0x6041)
    assert silence_s(master.bus.file) == 0.3  # longer than a few periods
    assert silence_s(bus_of(robot_of(bus_text(2, period_s=0.2))).file) == pytest.approx(0.6)
    assert times == [k * 50_000_000 for k in range(6)]
    assert run.now_ns() - began_ns == 300_000_000


@pytest.mark.parametrize("kind", ["", "silent", "emergency"])
def test_slow_drives_do_not_trigger_watchdog(tmp_path, kind):
    """Where a drive does not confirm, the session shows that it runs while it awaits answers; the
    others raise no 8130h.
    """
    session = beating_session(
        tmp_path / "a.mcap", [Fault(kind=kind, node=3, sync=150)] if kind else ()
    )
    assert session.outcome.fault == bool(kind)
    assert session.outcome.unconfirmed == ((3,) if kind == "silent" else ())
    assert len(session.outcome.reports) == (kind == "emergency")
    frames = session.frames
    emergencies = frames[(frames["can_id"] > 0x80) & (frames["can_id"] < 0x87)]
    assert emergencies["can_id"].tolist() == ([0x83] if kind == "emergency" else [])
    alive = [t for t, sign in Beating.signs if sign == "alive"]
    ended = [t for t, sign in Beating.signs if sign == "ended"]
    assert bool(ended) == (kind != "silent")
    last_ns = ended[0] if ended else frames["time_ns"][frames["can_id"] == 0].max()
    assert (
        max(b - a for a, b in itertools.pairwise([t for t in (*alive, last_ns) if t <= last_ns]))
        < 0.1e9
    )
    if not kind:
        (disabled_ns,) = [e.stamp_ns for e in session.recording.events if e.kind == "disabled"]
        assert last_ns <= disabled_ns
        restored = (
            (frames["can_id"] > 0x600)
            & (frames["data"][:, 1] == 0x16)
            & (frames["time_ns"] >= last_ns)
        )
        # the consumer heartbeats: all that comes after, and none of it counts
        assert restored.sum() == 4


def test_heartbeats_do_not_wait_for_recorder():
    here, there = multiprocessing.Pipe()
    life = WatchdogPipe(there)
    began = time.monotonic()
    for _ in range(70_000):  # more than a pipe holds
        life.alive()
    assert time.monotonic() - began < 30.0
    here.close()
    life.alive()
    life.close()
