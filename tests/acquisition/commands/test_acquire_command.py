"""robot-acquire: what it prints, how it ends, what it leaves behind."""

import json
import os
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import REPLAY, robot_named
from made_up_buses import bus_text
from made_up_recordings import header, some_frames, some_samples, write

from acquisition.commands import main
from acquisition.recording import SENT, RecordingWriter, read_recording

SCARA = REPLAY / "scara" / "robot.toml"
MAP = """
sample_rate_hz = 1000
[position]
columns = [1, 2]
unit = "rad"
[effort]
columns = [3, 4]
unit = "N m"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    np.savetxt(tmp_path / "a.csv", np.random.default_rng(0).normal(size=(300, 4)), delimiter=",")
    (tmp_path / "map.toml").write_text(MAP)
    return tmp_path


def import_command(folder: Path, out: Path) -> list[str]:
    return [
        "import",
        str(folder / "a.csv"),
        "--robot",
        str(SCARA),
        "--map",
        str(folder / "map.toml"),
        "-o",
        str(out),
    ]


def run(*arguments: str, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "acquisition", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, **options
    )  # type: ignore[call-overload,no-any-return]


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    assert main(arguments) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("robot-acquire: ")
    return captured.err


def test_info_shows_all_without_terminal_codes(tmp_path, capsys):
    log, start_ns = tmp_path / "a.mcap", 1_795_260_831_000_000_000
    write(log, robot_named("scara"))
    assert main(["info", str(log), "--json", "--csv", str(tmp_path / "a.csv")]) == 0
    found, recording = json.loads(capsys.readouterr().out), read_recording(log)
    position = recording.samples["position"][:, 1]
    assert (found["samples"], found["cut"], found["sha256"]) == (240, False, recording.sha256)
    assert found["joints"][1]["position"] == [position.min(), position.max()]
    assert found["attachments"] == {
        name: len(content) for name, content in recording.attachments.items()
    }
    assert main(["info", str(log)]) == 0
    text = capsys.readouterr().out
    sent = np.count_nonzero(some_frames(240)["flags"] & SENT)
    for part in (
        "SCARA", "a test", "made up", "240 at 1000 Hz", "with reference", "kernel_drops 200",
        "CAN can0",
        f"240 frames, {sent} of them sent, 0.239 s", "../../etc/drive.eds (11 bytes)", "complete",
        "shoulder", "elbow", "track",
        "stop", "gaps      none", "s from the first sample",
    ):  # fmt: skip
        assert part in text
    with RecordingWriter(
        tmp_path / "b.mcap", replace(header(robot_named("scara")), source="[bold]x\x1b[2J")
    ) as writer:
        samples = np.delete(some_samples(100), [50, 51])
        samples["stamp_ns"] += start_ns
        writer.samples(samples)
        writer.event(start_ns - 22_000_000, "phase", "\x1b]0;title\x07 [red]track[/red]")
    assert main(["info", str(tmp_path / "b.mcap")]) == 0
    text = capsys.readouterr().out
    assert all(
        part in text
        for part in ("1, 2 samples missing", "[bold]x", "[red]track[/red]", "-0.022000")
    )
    assert not {c for c in text if ord(c) < 32} - {"\n"}


def test_known_errors_are_one_line_without_files(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    Path("old.mcap").write_bytes(b"old")
    Path("bad.csv").write_text("1,2,3,4\n1,2,3,x\n")
    Path("robot.toml").write_text(bus_text(2, channel="nobody"))
    before, of_robot = sorted(folder.iterdir()), ["--robot", str(SCARA), "--map", "map.toml"]
    for command, told in (
        (
            ["import", "a.csv", *of_robot, "-o", str(folder)],
            "a folder or a device cannot be replaced",
        ),
        (["info", "a\nb.mcap"], "a b.mcap: the file cannot be read"),
        (
            ["import", "a.mcap", "a.mcap", "-o", "out"],
            "a.mcap: only one recording can be imported at a time",
        ),
        (["import", "a.mcap", "-o", "out", "--payload", "2"], "--payload = '2': a recording keeps"),
        (
            ["import", "a.csv", "--map", "map.toml", "-o", "out"],
            "--robot is missing: only recordings contain",
        ),
        (
            ["import", "bad.csv", *of_robot, "-o", "old.mcap", "--overwrite"],
            "line 2: column 4 = 'x'",
        ),
        (
            ["record", "robot.toml", "-o", "old.mcap", "--dry-run", "--duration", "1"],
            "already exists",
        ),
        (
            ["record", "robot.toml", "-o", "out", "--passive", "--dry-run"],
            "--passive: a passive session never sends",
        ),
        (
            ["record", "robot.toml", "-o", "out", "--duration", "0"],
            "--duration = 0.0: expected a finite number greater than 0",
        ),
        (["record", str(REPLAY / "emps" / "robot.toml"), "-o", "out"], "bus is missing"),
        (
            ["emulate", "old.mcap", "--interface", "virtual", "--channel", "x"],
            "is not an MCAP file",
        ),
        (
            ["emulate", "old.mcap", "--channel", "x"],
            "--interface is missing: the frames need a bus",
        ),
        (
            ["emulate", "old.mcap", "--duration", "1"],
            "--duration: this option is only for a robot.toml. Remove it",
        ),
        (
            ["emulate", "robot.toml", "--onto-bus"],
            "--onto-bus: this option is only for a recording. Remove it",
        ),
    ):
        assert told in refused(capsys, command)
    assert sorted(folder.iterdir()) == before
    assert Path("old.mcap").read_bytes() == b"old"


def test_inputs_are_not_replaced(folder, capsys):
    robot, log = folder / "robot.toml", folder / "log.mcap"
    robot.write_bytes(SCARA.read_bytes())
    assert main(import_command(folder, log)) == 0
    capsys.readouterr()
    before = {path: path.read_bytes() for path in folder.iterdir()}
    for out in (folder / "a.csv", folder / "map.toml", robot):
        arguments = import_command(folder, out)
        arguments[3] = str(robot)
        assert "the output is also an input" in refused(capsys, arguments)
    assert "the output is also an input" in refused(capsys, ["import", str(log), "-o", str(log)])
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("command", ["import", "import --topic /t", "import --map m.toml", "info"])
@pytest.mark.parametrize(("name", "content"), [("log.mcap", b"old"), ("log.bin", b"\x89MCAP0")])
def test_recording_is_not_replaced(folder, capsys, command, name, content):
    log = folder / name
    log.write_bytes(content)
    of_robot = ["--robot", str(SCARA)] if command.startswith("import") else []
    output = "--csv" if command == "info" else "-o"
    arguments = [*command.split(), "missing", *of_robot, output, str(log)]
    told = refused(capsys, arguments)
    assert told.startswith(f"robot-acquire: {log}: the file already exists")
    assert ("--overwrite" in told) == (command != "info")
    if command != "info":
        assert "already exists" not in refused(capsys, [*arguments, "--overwrite"])
    assert log.read_bytes() == content


def test_full_disk_is_one_line_without_files(folder):
    before = sorted(folder.iterdir())
    result = run(
        *import_command(folder, folder / "log.mcap"),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)),
        cwd=REPLAY.parent,
    )
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr.count("\n") == 1
    assert "log.mcap: the file cannot be written: File too large" in result.stderr
    assert sorted(folder.iterdir()) == before


def test_terminal_without_unicode(tmp_path):
    write(tmp_path / "a.mcap", robot_named("scara"))
    result = run(
        "info",
        str(tmp_path / "a.mcap"),
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        cwd=REPLAY.parent,
    )
    assert (result.returncode, result.stderr) == (0, "")
    assert "made up, R?" in result.stdout
