"""A stop that nothing can stop: what shows or notes raises, at any SYNC and from then on."""

import contextlib
import os
import shutil
import signal
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from dry_sessions import Fault, FaultyDrives, connected, dry_session, enable, swing
from made_up_buses import bus_text, robot_of

import acquisition.bus.stopping as stopping
from acquisition.bus import Frame, block_of, safe_stop, stop_drives
from acquisition.commands import main
from acquisition.commands.record import StatusLine
from acquisition.errors import BusFaultError, HeldBack
from acquisition.protocol import Command, State
from acquisition.recording import read_recording
from acquisition.session import InlineLog, Outcome, Recorder, Stop, Task

SLOW = robot_of(bus_text(2, period_s=0.02).replace("s2 = 4000", "s2 = 1000"))
TRACK = Task(reference=swing(2, seconds=0.5, period_s=0.02, amplitude=0.1))
ERRORS = (OSError(5, "Input/output error"), ValueError("of a callback"), KeyboardInterrupt())
EVERY = int(os.environ.get("HOOK_STEP", "13"))  # 1 tries each SYNC


@dataclass(kw_only=True)
class Raising:
    """Raises `error` in the calls from number `first` on, and counts them."""

    error: BaseException
    first: int = 0
    calls: int = 0

    def __call__(self, *_: object, **__: object) -> None:
        self.calls += 1
        if self.calls > self.first:
            raise self.error


class Log(InlineLog):
    """Calls `raising` before each call of the method `hook`; `on_status` is called every time."""

    def __init__(self, recorder: Recorder, hook: str, raising: Raising) -> None:
        super().__init__(recorder)
        self._hook, self._raising = hook, raising

    def _call(self, hook: str) -> None:
        if hook == self._hook:
            self._raising()

    def event(self, stamp_ns, kind, text):
        self._call("event")
        super().event(stamp_ns, kind, text)

    def poll(self, stamp_ns):
        status = super().poll(stamp_ns)
        self._call("poll")  # as its `on_status` does, which shows the status
        return status

    def ended(self):
        self._call("ended")


def session_with(path: Path, hook: str, raising: Raising, **how: object):
    path.unlink(missing_ok=True)
    log_of = partial(Log, hook=hook, raising=raising)
    return dry_session(path, TRACK, robot=SLOW, log_of=log_of, **how)


@pytest.mark.parametrize("hook", ["poll", "event", "ended"])
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_raising_hook_leaves_drives_disabled(tmp_path, hook, error):
    whole = Raising(error=error, first=10**9)
    session = session_with(tmp_path / "a.mcap", hook, whole)
    assert list(session.phases) == [
        "configure", "enable", "approach", "track", "stop", "disable"
    ]  # fmt: skip
    assert session.outcome.reason == "finished"
    for first in range(0, whole.calls, EVERY if hook == "poll" else 1):
        session = session_with(tmp_path / "a.mcap", hook, Raising(error=error, first=first))
        (announced,) = session.announced
        assert announced.unconfirmed == ()
        if isinstance(error, Exception) and session.raised is None:  # held back: all was done
            assert session.outcome.reason == "finished"
            assert hook == "event" or session.events("warning")[-1].endswith(str(error))
        else:
            assert session.raised is error
        if hook != "event":
            assert (session.events("disabled") or not session.sent.size) != []


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("confirms", [True, False])
def test_raising_announcement_is_in_events(tmp_path, error, confirms):
    """Drive 2 does not confirm where it falls silent."""
    raising, announced = Raising(error=error, first=0), list[Outcome]()

    def announce(outcome: Outcome) -> None:
        announced.append(outcome)
        raising()

    class Silent(FaultyDrives):
        def _answer(self, i, now_ns):
            frames = super()._answer(i, now_ns)
            if self._answered[1] > 60:
                self.silent = {1}
            return frames

    session = dry_session(
        tmp_path / "a.mcap",
        TRACK,
        robot=SLOW,
        announce=announce,
        simulated=FaultyDrives if confirms else Silent,
    )
    assert [outcome.unconfirmed for outcome in announced] == [() if confirms else (2,)]
    kind = "disabled" if confirms else "not disabled"
    assert [text.split(":")[0] for text in session.events(kind)] == [
        "every drive confirmed" if confirms else "NOT DISABLED"
    ]
    if isinstance(error, Exception):
        text = f"an error while the drives were stopped: {type(error).__name__}: {error}"
        assert text in session.events("warning")
        assert session.raised is None
    else:
        assert session.raised is error


@pytest.mark.parametrize("step", ["make_safe", "leave", "reports"])
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_raising_end_step_keeps_other_steps(tmp_path, monkeypatch, step, error):
    """Drives that nobody could stop are named: here they are disabled, and nobody has asked."""
    monkeypatch.setattr(f"acquisition.session.session._Session.{step}", Raising(error=error))
    fault = [Fault(kind="emergency", node=1, sync=40)] * (step == "reports")
    session = dry_session(tmp_path / "a.mcap", TRACK, robot=SLOW, faults=fault)
    unknown = step == "make_safe"
    assert [outcome.unconfirmed for outcome in session.announced] == [(1, 2) if unknown else ()]
    assert len(session.events("not disabled" if unknown else "disabled")) == 1
    assert session.raised is (None if isinstance(error, Exception) else error)


@pytest.mark.parametrize("where", ["receive", "send", "_collect"])
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_raising_link_does_not_end_stop(monkeypatch, error, where):
    """A driver raises in every third call for 0.2 s; an interrupt is kept for afterwards."""
    run, master = connected()
    enable(master)
    calls, until_ns = iter(range(10**9)), run.now_ns() + 200_000_000
    place = stopping if where == "_collect" else run
    real = getattr(place, where)

    def raising(*arguments):
        if next(calls) % 3 == 2 and run.now_ns() < until_ns:
            raise error
        return real(*arguments)

    monkeypatch.setattr(place, where, raising)
    held = HeldBack()
    assert safe_stop(master, held) == []
    assert run.drives.states == [State.SWITCH_ON_DISABLED] * 2
    if isinstance(error, Exception):
        assert held.problem == f"{type(error).__name__}: {error}"
        held.raise_interrupt()
    else:
        with pytest.raises(KeyboardInterrupt):
            held.raise_interrupt()


def test_interrupt_of_stop_is_raised_afterwards(monkeypatch):
    run, master = connected()
    enable(master)
    real, interrupts = run.receive, [KeyboardInterrupt()]

    def receive(until_ns):
        if interrupts:
            raise interrupts.pop()
        return real(until_ns)

    monkeypatch.setattr(run, "receive", receive)
    monkeypatch.setattr(stopping, "open_link", lambda *_, **__: closing_link(run))
    with pytest.raises(KeyboardInterrupt):
        stop_drives(master.bus)
    assert run.drives.states == [State.SWITCH_ON_DISABLED] * 2


@pytest.mark.parametrize(("error", "status"), [(ERRORS[0], 1), (KeyboardInterrupt(), 130)])
def test_drives_not_disabled_are_named_first(tmp_path, monkeypatch, capsys, error, status):
    (tmp_path / "robot.toml").write_bytes(SLOW.files["robot.toml"])
    monkeypatch.setattr(stopping, "open_link", Raising(error=error))
    assert main(["disable", str(tmp_path / "robot.toml")]) == status
    assert capsys.readouterr().err.startswith("NOT DISABLED: nodes 1, 2: EMERGENCY STOP\n")


def closing_link(run):
    run.close = lambda: None
    return run


def test_first_held_back_error_is_kept():
    held = HeldBack()
    for error in (BusFaultError("expected"), OSError("first"), ValueError("second"), SystemExit(3)):
        with held:
            raise error
    with held:
        raise KeyboardInterrupt
    assert held.problem == "OSError: first"
    with pytest.raises(SystemExit, match="3"):
        held.raise_interrupt()


@pytest.mark.parametrize(("reacts", "known"), [(False, True), (True, True), (False, False)])
def test_node_in_nmt_stopped_is_started_and_stopped(monkeypatch, reacts, known):
    """It takes neither PDO nor SDO there. By 6007h = 0 it goes on with what it was told last. That
    it is there may be `known` when the stop begins, or be heard after its requests were lost.
    """
    run, master = connected()
    enable(master)
    node = run.drives.nodes[0]
    node.values[0x6007, 0] = int(reacts)
    if known:
        run.send(0, bytes([2, 1]))  # by another master
        master.wait(run.now_ns() + 300_000_000)  # its heartbeat says so
        assert master.by_node[1].nmt == 4
    node.nmt = 4
    assert (node.state is State.OPERATION_ENABLED) is not reacts
    sent, real = [], run.send
    monkeypatch.setattr(run, "send", lambda *frame: (sent.append(frame), real(*frame)))
    since_ns = run.now_ns()
    assert safe_stop(master, HeldBack()) == []
    assert run.now_ns() - since_ns < (80_000_000 if known else 180_000_000)
    assert run.drives.states == [State.SWITCH_ON_DISABLED] * 2
    quick_stop = (
        0x601,
        bytes.fromhex("2B406000") + Command.QUICK_STOP.controlword.to_bytes(4, "little"),
    )
    if known:
        assert sent.index((0, bytes([128, 1]))) < sent.index(quick_stop)
    assert sent.count((0, bytes([128, 1]))) == 1
    assert (0, bytes([128, 2])) not in sent


@pytest.mark.parametrize(
    ("at", "cut_short"), [("enable", True), ("track", True), ("stop", False), (None, False)]
)
def test_unfinished_reference_is_cut_short(tmp_path, at, cut_short):
    stop = Stop()

    class Stopping(InlineLog):
        def event(self, stamp_ns, kind, text):
            super().event(stamp_ns, kind, text)
            if (kind, text) == ("phase", at):
                stop.reason = "stopped by SIGTERM"

    session = dry_session(tmp_path / "a.mcap", TRACK, robot=SLOW, stop=stop, log_of=Stopping)
    assert (session.outcome.fault, session.outcome.cut_short) == (False, cut_short)


def test_status_line_without_terminal_does_nothing(monkeypatch):
    controller, terminal = os.openpty()
    with open(terminal, "w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        line = StatusLine()
        line.show(("recording", False))
        os.close(controller)
        line.show(("recording", False))
        line.show(("\udcff", False))
        os.close(line._terminal)
        line.show(("recording", False))
        line.show()
        with contextlib.suppress(OSError):
            stderr.flush()


@pytest.mark.parametrize("how", ["file", "folder", "renamed"])
def test_deleted_recording_gets_new_name(tmp_path, how):
    """Its last name is gone, but not its descriptor; the folder may be gone too. A file that was
    only renamed is the recording all the same.
    """
    path = tmp_path / "session" / "a.mcap"
    path.parent.mkdir()
    (path.parent / "a-2.mcap").write_bytes(b"another")
    whole = dry_session(tmp_path / "whole.mcap", TRACK, robot=SLOW)

    class Deleted(InlineLog):
        def event(self, stamp_ns, kind, text):
            super().event(stamp_ns, kind, text)
            if (kind, text) == ("phase", "track"):
                if how == "folder":
                    shutil.rmtree(path.parent)
                elif how == "file":
                    path.unlink()
                else:
                    path.rename(tmp_path / "b.mcap")

    read = (
        tmp_path / "b.mcap"
        if how == "renamed"
        else path.with_stem("a-2" if how == "folder" else "a-3")
    )
    session = dry_session(path, TRACK, robot=SLOW, log_of=Deleted, read_from=read)
    if how == "renamed":
        assert session.outcome.reason == "finished"
        assert len(session.frames) == len(whole.frames)
        return
    assert session.outcome.reason == f"a.mcap was deleted; the recording is now in {read}"
    assert (session.outcome.fault, session.outcome.cut_short) == (False, True)
    assert session.recorded.path == read
    assert not session.recording.cut
    assert session.events("disabled") == ["every drive confirmed"]
    before = whole.frames["time_ns"] < session.phases["track"]
    np.testing.assert_array_equal(session.frames[: before.sum()], whole.frames[before])
    assert len(session.frames) > before.sum()


def test_late_deleted_recording_gets_new_name(tmp_path):
    recorder = Recorder(tmp_path / "a.mcap", SLOW, source="a test", place="robot.toml")
    recorder.add(block_of([Frame(1, 0x80, b"")]))
    (tmp_path / "a.mcap").unlink()
    assert recorder.finish(2).path == tmp_path / "a-2.mcap"
    assert not read_recording(tmp_path / "a-2.mcap").cut


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGTERM, 1), (signal.SIGHUP, 1), (signal.SIGINT, 0), (None, 0)]
)
def test_exit_status_of_unfinished_reference(
    tmp_path, monkeypatch, capsys, request, number, status
):
    """By signals that come with the first status of a dry run."""
    (tmp_path / "robot.toml").write_bytes(SLOW.files["robot.toml"])
    rows = np.column_stack([np.arange(len(TRACK.reference)) * 0.02, TRACK.reference])
    np.savetxt(tmp_path / "r.csv", rows, "%.17g", ",", header="time_s,joint_1,joint_2", comments="")

    def line(*_):
        if number is not None:
            signal.raise_signal(number)
        return []

    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # one that is ignored stays ignored
    request.addfinalizer(lambda: signal.signal(signal.SIGHUP, before))

    monkeypatch.setattr("acquisition.commands.record.live_line", line)
    out = tmp_path / "a.mcap"
    command = ["record", tmp_path / "robot.toml", "--track", tmp_path / "r.csv", "--dry-run"]
    assert main([str(word) for word in (*command, "--no-fit", "-o", out)]) == status
    errors = [x for x in capsys.readouterr().err.splitlines() if x.startswith("robot-acquire")]
    assert errors == [
        f"robot-acquire: {out}: the session ended early: stopped by {name}"
        for name in ([] if status == 0 else [number.name])
    ]


def test_session_without_frames_leaves_no_file(tmp_path):
    path, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    recorder = Recorder(path, SLOW, source="a test", place="robot.toml")
    recorder.event(1, "fault", "no bus")
    found = recorder.finish(2)
    assert (found.frames, found.path, path.exists()) == (0, None, False)
    recorder.close()
    recorder = Recorder(other, SLOW, source="a test", place="robot.toml")
    other.unlink()
    other.write_bytes(b"of somebody else")
    recorder.close()
    assert other.read_bytes() == b"of somebody else"
