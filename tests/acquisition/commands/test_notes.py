"""Notes of the operator: lines of standard input, in a terminal by the key m, as events of the
recording, which `info` shows.
"""

import os
import pty
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import ROOT
from made_up_buses import bus_text, robot_of

from acquisition.commands import main
from acquisition.commands.record import MAX_NOTE_BYTES, Notes, StatusLine
from acquisition.errors import RobotIdimError
from acquisition.recording import read_recording
from acquisition.session import Recorder


@pytest.fixture
def standard_input() -> Iterator[Callable[[int], None]]:
    """Makes a descriptor the standard input of this process until the test ends."""
    before = os.dup(0)
    yield lambda descriptor: (os.dup2(descriptor, 0), os.close(descriptor))
    os.dup2(before, 0)
    os.close(before)


@pytest.fixture
def keys(standard_input, monkeypatch) -> Iterator[int]:
    """A terminal as standard input, as if this process stood before it; writes what is typed."""
    controller, terminal = os.openpty()
    standard_input(terminal)
    monkeypatch.setattr(Notes, "_in_foreground", lambda _: True)
    yield controller
    os.close(controller)


def record_command(folder: Path) -> list[str]:
    (folder / "robot.toml").write_text(bus_text(2))
    return ["record", str(folder / "robot.toml"), "-o", str(folder / "log.mcap")]


def noted(folder: Path) -> list[str]:
    events = read_recording(folder / "log.mcap").events
    return [event.text for event in events if event.kind == "operator"]


def dry_run(folder: Path) -> list[str]:
    """The notes in the recording of 0.2 s."""
    assert main([*record_command(folder), "--dry-run", "--duration", "0.2"]) == 0
    return noted(folder)


def test_pipe_lines_are_notes(tmp_path, standard_input):
    read, write = os.pipe()
    os.write(write, b"tool\x1b[1m\t changed\r\n\n\xff\n" + b"x" * (MAX_NOTE_BYTES + 3) + b"\nend")
    os.close(write)
    standard_input(read)
    assert dry_run(tmp_path) == [
        "tool�[1m changed", "�", "x" * MAX_NOTE_BYTES, "xxx", "end"
    ]  # fmt: skip


@pytest.mark.parametrize("path", ["/dev/null", "/dev/zero", "/"])
def test_standard_input_never_ends_session(tmp_path, standard_input, path):
    standard_input(os.open(path, os.O_RDONLY))
    assert (len(dry_run(tmp_path)) > 50) == (path == "/dev/zero")


def press(keys: int, text: bytes) -> None:
    """Type a text, until the terminal has it and shows it."""
    os.write(keys, text)
    shown = b""
    while text.strip() not in shown:
        shown += os.read(keys, 1000)


def taken(notes: Notes, done: Callable[[list[str]], bool]) -> list[str]:
    """What is noted until that is enough, or ten seconds are over."""
    found, until_s = [], time.monotonic() + 10
    while not done(found) and time.monotonic() < until_s:
        found += notes.take()
        time.sleep(0.001)
    return found


def test_key_starts_note_with_line_editing(keys, monkeypatch):
    before, notes = termios.tcgetattr(0), Notes(StatusLine())
    press(keys, b"m kept\n")
    with monkeypatch.context() as behind:
        behind.setattr(Notes, "_in_foreground", lambda _: False)
        assert notes.take() == []
    assert termios.tcgetattr(0) == before, "in the background the terminal is left alone"
    assert taken(notes, bool) == ["kept"]
    assert termios.tcgetattr(0)[3] == before[3], "the line mode stays"
    os.write(keys, b"not this\nxm")
    assert taken(notes, lambda _: notes.typing) == []
    os.write(keys, b"two motors\x7f\x7f mm\nm \nm pasted m\n")
    assert taken(notes, lambda found: len(found) == 2) == ["two moto mm", "pasted m"]
    os.write(keys, b"m")
    assert taken(notes, lambda _: notes.typing) == []
    press(keys, b"not ended")
    notes.close()
    assert termios.tcgetattr(0) == before
    os.write(keys, b"behind\n")
    assert os.read(0, 100) == b"behind\n", "what was typed into the note is not the shell's"


def test_error_restores_terminal(tmp_path, keys, monkeypatch):
    before = termios.tcgetattr(0)

    def record(*arguments):
        arguments[-1].notes()
        assert termios.tcgetattr(0) != before
        raise KeyboardInterrupt

    monkeypatch.setattr("acquisition.session.record", record)
    assert main([*record_command(tmp_path), "--dry-run"]) == 130
    assert termios.tcgetattr(0) == before


@pytest.mark.parametrize(("answer", "moves"), [(b"yes\n", True), (b"m yes\n", False)])
def test_early_input_does_not_answer_question(tmp_path, keys, monkeypatch, capsys, answer, moves):
    def record(*arguments):
        press(keys, b"no\n" if moves else b"yes\n")
        threading.Timer(0.3, os.write, (keys, answer)).start()
        raise RobotIdimError(str(arguments[-1].confirm(["joint_1 = 0 deg"], [])))

    monkeypatch.setattr("acquisition.session.record", record)
    assert main([*record_command(tmp_path), "--track", "ref.csv"]) == 1
    assert capsys.readouterr().err.endswith(f"robot-acquire: {moves}\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_session_takes_notes_and_restores_terminal(tmp_path, number):
    command = [sys.executable, "-m", "acquisition", *record_command(tmp_path), "--dry-run"]
    process, terminal = pty.fork()
    if not process:
        os.chdir(ROOT)
        os.execv(sys.executable, command)
    before, until_s = termios.tcgetattr(terminal), time.monotonic() + 120

    def await_text(text: bytes) -> None:
        shown = b""
        while text not in shown:
            assert time.monotonic() < until_s
            shown = shown[-100:] + os.read(terminal, 10_000)

    await_text(b"frames/s")
    for typed, answer in ((b"m", b"note: "), (b"changed\n", b"frames/s"), (b"m", b"note: ")):
        os.write(terminal, typed)
        await_text(answer)
    os.write(terminal, b"half of one")
    os.kill(process, number)
    await_text(f"stopped by {number.name}".encode())
    assert termios.tcgetattr(terminal) == before
    os.close(terminal)
    os.waitpid(process, 0)
    assert noted(tmp_path) == ["changed"]


def test_info_shows_notes_among_many_events(tmp_path, capsys):
    path = tmp_path / "log.mcap"
    recorder = Recorder(path, robot_of(bus_text(2)), source="test", place="robot.toml")
    for k in range(26):
        recorder.event(k, "operator" if k == 25 else "mark", f"event {k}.")
    recorder.finish(100)
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert ("event 25." in shown, "event 24." in shown) == (True, False)
