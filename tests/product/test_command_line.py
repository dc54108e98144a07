"""How commands end: files before words, a status that says what happened, streams that cannot fail a command."""

import os
import platform
import subprocess
import sys
from argparse import Namespace
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import pytest
from conftest import REPLAY, ROOT
from made_up_recordings import write

from acquisition.commands import STATUSES, Progress, from_options, run_command
from acquisition.commands import main as acquire
from acquisition.errors import BadInputError, RobotIdimError
from acquisition.robot import load_robot
from identification.commands import main as identify

SCARA = REPLAY / "scara" / "robot.toml"
SESSION = REPLAY / "scara" / "session.mcap"
FIT = REPLAY / "scara" / "fit.json"


def in_shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """What a shell makes of a line in which ID and ACQ stand for the programs; the status is that of the program."""
    for name, package in (("ID", "identification"), ("ACQ", "acquisition")):
        command = command.replace(name, f"{sys.executable} -m {package}")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        ["bash", "-c", f"{command}; exit ${{PIPESTATUS[0]}}"],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("program", "command", "files"),
    [
        (identify, f"fit {SESSION} --json j --rrd r", ["j", "r"]),
        (identify, f"validate {FIT} {SESSION} --json j", ["j"]),
        (identify, f"compare {FIT} {FIT} --report r.html", ["r.html"]),
        (identify, f"base {SCARA} --json j", ["j"]),
        (identify, f"study {SCARA} --runs 1 --duration-s 3 --json j", ["j"]),
        (identify, f"view {SESSION} -o r", ["r"]),
        (identify, f"simulate {SCARA} -o m --duration-s 2", ["m"]),
        (acquire, f"export {SESSION} -o c", ["c"]),
        (acquire, f"import {SESSION} -o m", ["m"]),
        (acquire, f"info {SESSION}", []),
    ],
    ids=lambda given: given.split()[0] if isinstance(given, str) else None,
)
def test_a_reader_that_is_gone_before_the_first_line_costs_nothing(
    program, command, files, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    read, written = os.pipe()
    os.close(read)
    with open(written, "w", buffering=1) as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert program(command.split()) == 0
    assert capfd.readouterr().err == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == files
    assert all((tmp_path / name).stat().st_size > 100 for name in files)


def test_head_loses_nothing(tmp_path):
    done = in_shell(f"ID fit {SESSION} --json j --rrd r | head -1", tmp_path)
    assert (done.returncode, done.stderr, done.stdout.count("\n")) == (0, "", 1)
    assert (tmp_path / "j").stat().st_size > 1000
    assert (tmp_path / "r").stat().st_size > 100_000


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_under_standard_output_is_told_after_the_files_are_written(tmp_path):
    done = in_shell(f"ID base {SCARA} --json j > /dev/full", tmp_path)
    assert done.returncode == 1
    assert done.stderr == "robot-identify: standard output: cannot be written: No space left on device\n"
    assert (tmp_path / "j").stat().st_size > 100


def test_closed_streams_are_as_good_as_none(tmp_path):
    """The number of a closed stream is not given to the next file: what is printed would stand in it."""
    write(tmp_path / "a.mcap", load_robot(SCARA))
    done = in_shell("ACQ export a.mcap -o a.csv >&-", tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "a.csv").read_text().startswith("time_s")
    done = in_shell("ACQ info none.mcap 2>&-", tmp_path)
    assert (done.returncode, done.stdout) == (1, ""), "an error is not a result"
    (tmp_path / "number.py").write_text(
        "from acquisition.commands import run_command\n"
        "def command():\n    with open('number', 'w') as file:\n        file.write(str(file.fileno()))\n"
        "raise SystemExit(run_command('p', (), command))\n"
    )
    done = in_shell(f"{sys.executable} number.py >&- 2>&- <&-", tmp_path)
    assert done.returncode == 0
    assert int((tmp_path / "number").read_text()) > 2
    if Path("/dev/full").exists():
        assert in_shell("ACQ info a.mcap 2>/dev/full", tmp_path).stdout.count("SCARA") >= 1
        assert in_shell("ACQ info none.mcap 2>/dev/full", tmp_path).returncode == 1


def test_a_fault_is_told_though_nobody_reads_the_findings(tmp_path):
    """`check | head -1` on a bus on which no drive answers: no go is status 1 however little of it is read."""
    text = (REPLAY / "scara" / "robot.toml").read_text()
    assert "[bus]" in text
    (tmp_path / "robot.toml").write_text(text.replace('channel = "scara"', 'channel = "nobody"'))
    done = in_shell("ACQ check robot.toml | true", tmp_path)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1


def test_a_picture_that_cannot_be_written_costs_neither_the_fit_nor_its_table(tmp_path, capsys):
    assert identify(["fit", str(SESSION), "--json", str(tmp_path / "j"), "--rrd", str(tmp_path / "none" / "r")]) == 1
    printed = capsys.readouterr()
    assert f"{tmp_path}/none/r" in printed.err
    assert printed.err.count("\n") == 1
    assert "ZZ1R" in printed.out
    assert (tmp_path / "j").exists()


@pytest.mark.parametrize(
    ("end", "status", "expected"),
    [
        (None, 0, ""),
        (0, 0, ""),
        (3, 3, ""),
        (RobotIdimError("a: b"), 1, "p: a: b\n"),
        (KeyboardInterrupt(), 130, "p: interrupted\n"),
        (PermissionError(13, "Permission denied", "x\ny"), 1, "p: x y: Permission denied\n"),
    ],
)
def test_statuses(end, status, expected, capsys):
    def command():
        print("result")
        if isinstance(end, BaseException):
            raise end
        return end

    assert run_command("p", (RobotIdimError,), command) == status
    assert capsys.readouterr() == ("result\n", expected)


def test_an_error_that_nobody_foresaw_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        run_command("p", (RobotIdimError,), lambda: 1 // 0)


@pytest.mark.parametrize("package", ["acquisition", "identification"])
def test_statuses_stand_in_the_help_and_in_the_readme(package, capsys):
    with pytest.raises(SystemExit) as stopped:
        (acquire if package == "acquisition" else identify)(["--help"])
    assert stopped.value.code == 0
    assert STATUSES in " ".join(capsys.readouterr().out.split())
    readme = (ROOT / "identification" / "first_session.md").read_text()
    for status in ("0", "1", "2", "3", "130"):
        assert f"| {status} |" in readme
        assert f" {status} " in STATUSES


def test_what_is_gone_is_told_with_the_new_way(capsys):
    key = "under [identification] of robot.toml"
    for program, words, gone in (
        (acquire, ["decode", "a.mcap", "-o", "b.mcap"], "decode is gone: use import LOG.mcap -o OUT.mcap"),
        (acquire, ["recover", "a.mcap", "-o", "b.mcap"], "recover is gone: use import CUT.mcap -o OUT.mcap"),
        (identify, ["fit", "a.mcap", "--max-iterations=3"], f"--max-iterations is gone: use max_iterations {key}"),
        (identify, ["view", "a.mcap", "--all-samples"], f'--all-samples is gone: use span = "all" {key}'),
        (
            identify,
            ["fleet", "--low-speed-percent", "0"],
            f"fleet --low-speed-percent is gone: use low_speed_percent {key}",
        ),
        (identify, ["fit", "a.mcap", "--cluster=tcp://host:1"], "--cluster is gone: use --workers tcp://HOST:8786"),
        (identify, ["fit", "a.mcap", "--decimate", "5"], f"--decimate is gone: use decimation {key}"),
        (identify, ["view", "a.mcap", "--torque-lag-s=0"], f"view --torque-lag-s is gone: use torque_lag_s {key}"),
        (identify, ["demo", "--noise", "5"], "demo --noise is gone: use simulate --effort-noise-percent"),
        (
            identify,
            ["fleet", "a", "--rrd", "b"],
            "fleet --rrd is gone: use the table of -o OUT.csv, which marks changes",
        ),
        (acquire, ["simulate", "robot.toml"], "simulate is gone: use emulate"),
        (identify, ["study", "robot.toml", "--rrd=s.rrd"], "study --rrd is gone: use --report FILE.html"),
        (identify, ["schema", "robot"], "schema is gone: all keys of robot.toml are in identification/reference.md"),
        (
            identify,
            ["compare", "a", "b", "--rrd=c"],
            "compare --rrd is gone: use --report FILE.html, which has the charts",
        ),
    ):
        with pytest.raises(SystemExit) as stopped:
            program(words)
        assert stopped.value.code == 2
        assert capsys.readouterr().err.splitlines()[-1].endswith(f": error: {gone}")
    assert acquire(["info", "simulate"]) == 1, "a file of that name"


def test_names_that_are_no_files_are_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    for command in (
        ["fit", "loop"],
        ["base", "loop"],
        ["compare", "loop", str(FIT)],
        ["view", ""],
        ["view", "."],
    ):
        assert identify(command) == 1
        printed = capsys.readouterr()
        assert printed.err.startswith("robot-identify: ")
        assert printed.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["loop"]


def test_a_bus_that_cannot_be_opened_is_one_line(tmp_path):
    """python-can warns of the half-opened bus when it is thrown away."""
    text = SCARA.read_text().replace('interface = "virtual"', 'interface = "udp_multicast"')
    (tmp_path / "robot.toml").write_text(text.replace('channel = "scara"', 'channel = "nowhere"'))
    done = in_shell("ACQ check robot.toml", tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "bus: udp_multicast nowhere: cannot be opened" in done.stderr


@pytest.mark.parametrize(("program", "name"), [(acquire, "robot-acquire"), (identify, "robot-identify")])
def test_versions_are_those_of_what_is_installed(program, name, capsys):
    with pytest.raises(SystemExit) as stopped:
        program(["--version"])
    assert stopped.value.code == 0
    first, *others = capsys.readouterr().out.splitlines()
    assert first == f"{name} {metadata.version('robot-idim')}"
    versions = dict(line.split() for line in others)
    assert versions.pop("Python") == platform.python_version()
    assert {"numpy", "scipy", "pin", "rerun-sdk", "mcap", "python-can", "canopen"} <= set(versions)
    assert versions == {package: metadata.version(package) for package in versions}


def test_the_help_of_a_fit_has_groups(capsys):
    with pytest.raises(SystemExit):
        identify(["fit", "--help"])
    parts = capsys.readouterr().out.split("\n\n")
    groups = {title: text for title, _, text in (part.partition(":\n") for part in parts)}
    for title, option in (
        ("inputs", "--robot"),
        ("settings of the fit", "--cutoff-hz"),
        ("settings of the fit", "--start"),
        ("outputs", "--rrd"),
    ):
        assert option in groups[title]


def test_options_become_fields():
    @dataclass(frozen=True, kw_only=True)
    class Settings:
        span: str = "motion"
        factor: int = 3
        share: float | None = None
        start: str = "regular"

    options = Namespace(span=None, factor=0, other=1, start="ls")
    assert from_options(Settings, options) == Settings(factor=0, start="ls")
    assert from_options(Settings, options, start="a file", share=0.5) == Settings(factor=0, start="a file", share=0.5)


def test_progress_is_shown_on_a_terminal_only(capfd, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with Progress("reading") as progress:
        progress.say("fitting")
    assert capfd.readouterr() == ("", ""), "an error is a line of its own in a file too"
    monkeypatch.setenv("TERM", "xterm")
    controller, terminal = os.openpty()
    with open(terminal, "w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        with Progress("reading") as progress:
            progress.say("fitting")
        stderr.write("the end")
        stderr.flush()
        printed = ""
        while not printed.endswith("the end"):
            printed += os.read(controller, 1000).decode()
    os.close(controller)
    assert "fitting" in printed
    assert printed.endswith("\x1b[2Kthe end")


@pytest.mark.parametrize(
    ("program", "command", "line"),
    [
        (identify, "fit a.mcap --cutof-hz 3", "error: unrecognized arguments: --cutof-hz 3: did you mean --cutoff-hz?"),
        (identify, "fti a.mcap", "error: argument COMMAND: invalid choice: 'fti': did you mean fit?"),
        (
            identify,
            "fit a.mcap --method olss",
            " fit: error: argument --method: invalid choice: 'olss': did you mean ols?",
        ),
        (identify, "fit a.mcap --cutoff-hz 0", "argument --cutoff-hz: '0': expected a number above 0, or none"),
        (
            identify,
            "simulate robot.toml -o a.mcap --rate-hz 0.008",
            "argument --rate-hz: '0.008': expected a rate in Hz from 1; 0.008 s is 125 Hz",
        ),
        (identify, "fit", " fit: error: the following arguments are required: LOG.mcap"),
        (acquire, "impotr a.csv", "error: argument COMMAND: invalid choice: 'impotr': did you mean import?"),
        (acquire, "info a.mcap --jsn", "error: unrecognized arguments: --jsn: did you mean --json?"),
        (acquire, "info a.mcap --zzz", "error: unrecognized arguments: --zzz"),
    ],
)
def test_wrong_usage_is_one_line_with_what_was_meant(program, command, line, capsys):
    with pytest.raises(SystemExit) as stopped:
        program(command.split())
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("robot-")
    assert said.endswith(f"{line}\n")


def test_a_method_may_be_in_capitals(capsys):
    printed = []
    for method in ("IV", "iv"):
        assert identify(["fit", str(SESSION), "--method", method]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]


def test_a_shell_completes_commands_options_and_files(capsys, monkeypatch):
    pytest.importorskip("shtab")
    for program, words in (
        (identify, ["_fit___method_choices=(ols wls iv)", "_fit_pos_0_COMPGEN=_shtab_compgen_files"]),
        (acquire, ["_import_option_strings=(", "_check_pos_0_COMPGEN=_shtab_compgen_files"]),
    ):
        with pytest.raises(SystemExit) as stopped:
            program(["--print-completion", "bash"])
        assert stopped.value.code == 0
        printed = capsys.readouterr().out
        assert all(word in printed for word in words)


def test_completion_asks_for_its_package(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "shtab", None)
    with pytest.raises(SystemExit) as stopped:
        identify(["--print-completion", "bash"])
    assert stopped.value.code == 2
    needs = "--print-completion needs shtab: pip install 'robot-idim[completion]'"
    assert capsys.readouterr().err == f"robot-identify: error: {needs}\n"


def test_exchanged_arguments_are_told(capsys):
    others = str(REPLAY / "tx40" / "session.mcap")
    for command in ([SESSION, FIT], [SESSION, others, FIT]):
        assert identify(["validate", *map(str, command)]) == 1
        right = " ".join(map(str, [FIT, *command[:-1]]))
        assert capsys.readouterr().err == (
            f"robot-identify: {SESSION}: is no fit: expected the fit first: `robot-identify validate {right}`\n"
        )


@pytest.mark.parametrize("start", [b"", b"\xef\xbb\xbf", b"\n "])
def test_a_urdf_in_place_of_a_description_is_told(start, tmp_path, monkeypatch, capsys):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "arm.urdf").write_bytes(start + b'<?xml version="1.0"?><robot name="a"/>')
    monkeypatch.chdir(tmp_path)
    for program, command in (
        (acquire, ["check"]),
        (identify, ["fit", str(SESSION), "--robot"]),
        (acquire, ["import", "a.csv", "--map", "map.toml", "-o", "a.mcap", "--robot"]),
    ):
        assert program([*command, "folder/arm.urdf"]) == 1
        said = capsys.readouterr().err
        assert said.endswith(
            ": folder/arm.urdf: is a URDF: expected a robot.toml; "
            "`robot-identify init folder/arm.urdf -o robot.toml` makes one\n"
        )
        assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("start", "text"), [(b'{"format": 8}', "is a JSON file"), (b"\x89MCAP0\r\n", "is a recording")]
)
def test_another_file_in_place_of_a_description_is_named(start, text, tmp_path):
    (tmp_path / "fit").write_bytes(start)
    with pytest.raises(BadInputError) as refused:
        load_robot(tmp_path / "fit")
    assert str(refused.value).startswith(f"{tmp_path / 'fit'}: {text}: expected a robot.toml")


def test_a_computer_without_can_is_told_what_to_do(capsys, monkeypatch):
    import can

    def no_can(**_: object) -> None:
        raise OSError(97, "Address family not supported by protocol")

    monkeypatch.setattr(can, "Bus", no_can)
    assert acquire(["scan", "--interface", "socketcan", "--channel", "can0"]) == 1
    assert capsys.readouterr().err == (
        "robot-acquire: bus: socketcan can0: cannot be opened: [Errno 97] Address family not supported by protocol: expected "
        "CAN in Linux (modprobe can_raw) and its channel in `ip link`; or another interface\n"
    )


def test_drives_that_nobody_could_join_are_not_emulated(capsys):
    assert acquire(["emulate", str(SCARA), "--duration", "0.1"]) == 1
    assert capsys.readouterr().err.startswith(
        f"robot-acquire: {SCARA}: bus.interface = 'virtual': other programs cannot join it: expected udp_multicast or "
    )
