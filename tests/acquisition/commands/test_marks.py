"""Marks of an operator: noted beside a recording that is being written, copied
into it, shown by `info`.
"""

import fcntl
import os
import time
from pathlib import Path

import pytest
from dry_sessions import dry_session
from made_up_buses import bus_text, robot_of

from acquisition.commands import main
from acquisition.recording import add_mark, read_recording
from acquisition.session import InlineLog, Recorder, Task


@pytest.fixture
def recorder(tmp_path: Path) -> Recorder:
    return Recorder(tmp_path / "log.mcap", robot_of(bus_text(2)), source="test", place="robot.toml")


class Marked(InlineLog):
    path: Path
    polls = 0

    def poll(self, stamp_ns):
        self.polls += 1
        if self.polls in (3, 300):
            assert main(["mark", str(self.path), f"bumped\n{self.polls} times"]) == 0
        return super().poll(stamp_ns)

    def finish(self, stamp_ns):
        assert main(["mark", str(self.path), "at the end"]) == 0
        return super().finish(stamp_ns)


def test_marks_are_events_of_the_recording(tmp_path):
    path = tmp_path / "log.mcap"
    done = dry_session(path, Task(duration_s=2.0), log_of=type("Here", (Marked,), {"path": path}))
    assert done.events("operator") == ["bumped 3 times", "bumped 300 times", "at the end"]
    marks = [e.stamp_ns for e in done.recording.events if e.kind == "operator"]
    assert marks == sorted(marks)
    assert marks[1] < done.recording.samples["stamp_ns"][-1]
    assert not list(tmp_path.glob("*.marks*"))


def test_a_mark_keeps_its_time_what_is_no_mark_is_left_out_and_info_shows_it_behind_others(
    tmp_path, capsys, recorder
):
    path, second = tmp_path / "log.mcap", 10**9
    before, ahead = time.time_ns() - 2 * second, time.time_ns() + 9 * second
    lines = [f'[{before}, "before"]', "nonsense", "[1]", f'[{ahead}, "ahead"]', "[null, 1]"]
    for k in range(25):
        recorder.event(k, "mark", f"event {k}.")
    # of a recorder that was killed
    Path(f"{path}.marks.taken").write_text(f'[{before - 1}, "left over"]\n')
    (tmp_path / "log.mcap.marks").write_bytes("\n".join(lines).encode() + b"\n\xff\n")
    recorder.finish(100 * second)
    found = [e for e in read_recording(path).events if e.kind == "operator"]
    assert [e.text for e in found] == ["left over", "before", "ahead"]
    assert 97.5 < found[1].stamp_ns / second <= 98
    assert found[2].stamp_ns == 100 * second
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert ("ahead" in shown, "event 24." in shown) == (True, False)


HOSTILE = {
    "infinite": b'[1e400,"x"]',
    "deep": b"[" * 50_000,
    "digits": b"[" + b"9" * 100_000 + b',"x"]',
    "surrogate": rb'[1,"\ud800"]',
    "bytes": b'[1,"\xff\xfe"]\x00\r[',
    "large": b'[1,"x"]\n' * 200_000,
    "folder": Path.mkdir,
    "pipe": os.mkfifo,
    "endless": lambda path: path.symlink_to("/dev/zero"),
}


def test_nothing_in_the_place_of_marks_ends_a_session(tmp_path, recorder):
    path, marks, stay = tmp_path / "log.mcap", tmp_path / "log.mcap.marks", []
    for k, (name, content) in enumerate(HOSTILE.items()):
        if isinstance(content, bytes):
            marks.write_bytes(content + b"\n")
            if len(content) <= 2**20:
                add_mark(path, f"after {name}")
        else:
            content(marks)
        assert recorder.tick(10**9 + k, 0, now=True) is not None
        if os.path.lexists(marks):
            stay.append(name)
            marks.rename(marks.with_suffix(f".{k}"))
    recorder.finish(2 * 10**9)
    assert stay == ["large", "folder", "pipe", "endless"]
    marked = [e.text for e in read_recording(path).events if e.kind == "operator"]
    assert marked == [f"after {name}" for name in HOSTILE if name not in stay]


def test_who_keeps_the_lock_of_marks_does_not_hold_up_the_recorder(tmp_path, recorder):
    path = tmp_path / "log.mcap"
    add_mark(path, "kept")
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        started_s = time.monotonic()
        recorder.tick(10**9, 0, now=True)
        assert time.monotonic() - started_s < 0.5
        recorder.finish(2 * 10**9)
        assert time.monotonic() - started_s < 10
    assert "kept" in Path(f"{path}.marks").read_text()


@pytest.mark.parametrize("kind", ["finished", "cut", "none", "table"])
def test_a_mark_without_a_recording_that_is_written(tmp_path, capsys, recorder, kind):
    path = tmp_path / "log.mcap"
    if kind == "finished":
        recorder.finish(10**9)
    elif kind == "none":
        path.unlink()
    elif kind == "table":
        path.write_text("t,q1")
    if kind in ("cut", "table"):
        os.utime(path, (time.time() - 20, time.time() - 20))
    assert main(["mark", str(path), "too late"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"robot-acquire: {path}: ")
    assert error.count("\n") == 1
    assert not list(tmp_path.glob("*.marks*"))
