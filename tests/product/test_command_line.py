"""How commands end: files before words, a status that says what happened, streams that
cannot fail a command.
"""

import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from conftest import ACQUIRE, IDENTIFY, REPLAY, ROOT

from acquisition.commands import STATUSES, Progress, run_command
from acquisition.commands import main as acquire
from acquisition.errors import RobotIdimError
from identification.commands import main as identify

SCARA = REPLAY / "scara" / "robot.toml"
SESSION = REPLAY / "scara" / "session.mcap"
FIT = REPLAY / "scara" / "fit.json"


@pytest.mark.parametrize(
    ("program", "command", "files"),
    [
        (identify, f"fit {SESSION} --json j --rrd r", ["j", "r"]),
        (identify, f"validate {FIT} {SESSION} --json j", ["j"]),
        (identify, f"compare {FIT} {FIT} --report r.html", ["r.html"]),
        (identify, f"simulate {SCARA} -o m --duration-s 2", ["m"]),
        (acquire, f"info {SESSION} --csv c", ["c"]),
        (acquire, f"info {SESSION}", []),
    ],
    ids=lambda given: given.split()[0] if isinstance(given, str) else None,
)
def test_closed_output_pipe_loses_nothing(program, command, files, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    read, written = os.pipe()
    os.close(read)
    with open(written, "w", buffering=1) as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert program(command.split()) == 0
    assert capfd.readouterr().err == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == files
    assert all((tmp_path / name).stat().st_size > 100 for name in files)


needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
NO_SPACE = "robot-identify: standard output cannot be written: No space left on device\n"
WITHOUT_STREAMS = """from acquisition.commands import run_command
def command():
    with open("number", "w") as file:
        file.write(str(file.fileno()))
raise SystemExit(run_command("p", command))
"""


@pytest.mark.parametrize(
    ("line", "status", "error", "files"),
    [
        ("ID base SCARA --json j | head -1", 0, "", ["j"]),
        pytest.param("ID base SCARA --json j > /dev/full", 1, NO_SPACE, ["j"], marks=needs_full),
        ("ACQ info SESSION --csv c >&-", 0, "", ["c"]),
        ("ACQ info none.mcap 2>&-", 1, "", []),
        pytest.param("ACQ info none.mcap 2>/dev/full", 1, "", [], marks=needs_full),
        ("PYTHON without_streams.py >&- 2>&- <&-", 0, "", ["number"]),
        (
            "ACQ check nowhere.toml | true",
            1,
            "bus: udp_multicast nowhere: the bus cannot be opened",
            [],
        ),
        # no drive answers: the check fails, however little of it is read
        ("ACQ check nobody.toml | true", 1, "", []),
    ],
)
def test_unwritable_streams_lose_nothing(line, status, error, files, tmp_path):
    """The number of a closed stream is not given to the next file: what is
    printed would stand in it.
    """
    text = SCARA.read_text()
    (tmp_path / "nobody.toml").write_text(text.replace('channel = "scara"', 'channel = "nobody"'))
    text = text.replace('channel = "scara"', 'channel = "nowhere"').replace(
        '"virtual"', '"udp_multicast"'
    )
    (tmp_path / "nowhere.toml").write_text(text)
    (tmp_path / "without_streams.py").write_text(WITHOUT_STREAMS)
    before = {*tmp_path.iterdir()}
    python = sys.executable
    words = {
        "PYTHON": python,
        "ID": f"{python} -m identification",
        "ACQ": f"{python} -m acquisition",
    }
    words |= {"SCARA": str(SCARA), "SESSION": str(SESSION)}
    command = " ".join(words.get(word, word) for word in line.split())
    done = subprocess.run(
        ["bash", "-c", f"{command}; exit ${{PIPESTATUS[0]}}"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == status
    assert error in done.stderr
    assert done.stderr.count("\n") == (1 if error or "nobody" in line else 0)
    assert sorted(path.name for path in {*tmp_path.iterdir()} - before) == files
    for name in files:
        written = (tmp_path / name).read_text()
        assert int(written) > 2 if name == "number" else len(written) > 100


def test_unwritable_plot_keeps_fit_and_table(tmp_path, capsys):
    assert (
        identify(
            [
                "fit",
                str(SESSION),
                "--json",
                str(tmp_path / "j"),
                "--rrd",
                str(tmp_path / "none" / "r"),
            ]
        )
        == 1
    )
    printed = capsys.readouterr()
    assert f"{tmp_path}/none/r" in printed.err
    assert printed.err.count("\n") == 1
    assert "ZZ1R" in printed.out
    assert (tmp_path / "j").exists()


@pytest.mark.parametrize(
    ("end", "status", "expected"),
    [
        (None, 0, ""),
        (3, 3, ""),
        (RobotIdimError("a: b"), 1, "p: a: b\n"),
        (KeyboardInterrupt(), 130, "p: interrupted\n"),
        (PermissionError(13, "Permission denied", "x\ny"), 1, "p: x y: Permission denied\n"),
    ],
)
def test_exit_statuses(end, status, expected, capsys):
    def command():
        print("result")
        if isinstance(end, BaseException):
            raise end
        return end

    assert run_command("p", command) == status
    assert capsys.readouterr() == ("result\n", expected)


def test_unexpected_error_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        run_command("p", lambda: 1 // 0)


@pytest.mark.parametrize("package", ["acquisition", "identification"])
def test_exit_statuses_are_in_help_and_guide(package, capsys):
    with pytest.raises(SystemExit) as stopped:
        (acquire if package == "acquisition" else identify)(["--help"])
    assert stopped.value.code == 0
    assert STATUSES in " ".join(capsys.readouterr().out.split())
    page = (ROOT / "identification" / "docs" / "start.md").read_text()
    for status in ("0", "1", "2", "3", "130"):
        assert f"`{status}` " in page.partition("**Exit status**")[2]
        assert f" {status} " in STATUSES


@pytest.mark.parametrize(("program", "lines"), [(ACQUIRE, 24), (IDENTIFY, 30)])
def test_help_fits_one_screen(program, lines, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        program.main(["--help"])
    assert capsys.readouterr().out.count("\n") <= lines


def test_invalid_file_name_gives_one_line(tmp_path, monkeypatch, capsys):
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
    assert acquire(["info", "simulate"]) == 1, "a file with the name of a command that is gone"
    assert [path.name for path in tmp_path.iterdir()] == ["loop"]


@pytest.mark.parametrize(
    ("program", "name"), [(acquire, "robot-acquire"), (identify, "robot-identify")]
)
def test_version_is_installed_version(program, name, capsys):
    with pytest.raises(SystemExit) as stopped:
        program(["--version"])
    assert stopped.value.code == 0
    first, *others = capsys.readouterr().out.splitlines()
    assert first == f"{name} {metadata.version('robot-idim')}"
    versions = dict(line.split() for line in others)
    assert versions.pop("Python") == platform.python_version()
    assert {"numpy", "scipy", "pin", "rerun-sdk", "mcap", "python-can", "canopen"} <= set(versions)
    assert versions == {package: metadata.version(package) for package in versions}


@pytest.mark.parametrize(
    ("given", "threads"),
    [({}, 1), ({"OPENBLAS_NUM_THREADS": "2"}, 2), ({"OMP_NUM_THREADS": "2"}, 2)],
    ids=lambda given: " ".join(given) if isinstance(given, dict) else "",
)
def test_one_blas_thread_by_default(given, threads):
    code = (
        "from contextlib import suppress\nfrom identification.commands import main\n"
        "with suppress(SystemExit): main(['--help'])\n"
        "import numpy, threadpoolctl\nprint(threadpoolctl.threadpool_info()[0]['num_threads'])"
    )
    env = {x: value for x, value in os.environ.items() if "NUM_THREADS" not in x} | given
    told = subprocess.check_output([sys.executable, "-c", code], text=True, env=env)
    assert told.splitlines()[-1] == str(min(threads, os.cpu_count() or 1))


def test_progress_on_terminal_only(capfd, monkeypatch):
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
        (
            identify,
            "fit a.mcap --cutof-hz 3",
            "error: unrecognized arguments: --cutof-hz 3: did you mean --cutoff-hz?",
        ),
        (
            identify,
            "fit a --method olss",
            " fit: error: argument --method: invalid choice: 'olss': did you mean ols?",
        ),
        (
            identify,
            "fit a.mcap --cutoff-hz 0",
            "argument --cutoff-hz: '0': expected a number greater than 0, or none",
        ),
        (
            identify,
            "fit a.mcap --meth wls",
            "error: unrecognized arguments: --meth wls: did you mean --method?",
        ),
        (
            identify,
            "simulate a -o b --rate-hz 0.008",
            "'0.008': expected a rate of at least 1 Hz (0.008 s is 125 Hz)",
        ),
        (identify, "fit", " fit: error: the following arguments are required: LOG.mcap"),
        (
            acquire,
            "impotr a.csv",
            "error: argument COMMAND: invalid choice: 'impotr': did you mean import?",
        ),
        (
            acquire,
            "decode a.mcap -o b.mcap",
            "error: decode no longer exists: use import LOG.mcap -o OUT.mcap",
        ),
        (
            acquire,
            "mark a.mcap bumped",
            "error: mark no longer exists: press the key m in robot-acquire record, or pipe a "
            "line into it",
        ),
        (
            identify,
            "fit a --cluster=tcp://host:1",
            "error: --cluster no longer exists: use --workers tcp://HOST:8786",
        ),
        (identify, "sensitivity a.mcap", "error: sensitivity no longer exists: use study LOG.mcap"),
        (
            identify,
            "study a --rrd s.rrd",
            "error: study --rrd no longer exists: use --report FILE.html",
        ),
    ],
)
def test_typing_error_gets_suggestion(program, command, line, capsys):
    with pytest.raises(SystemExit) as stopped:
        program(command.split())
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("robot-")
    assert said.endswith(f"{line}\n")


@pytest.mark.parametrize(
    ("program", "typed", "meant"),
    [
        # one letter too many, too few, another, two exchanged; a part of a long name
        (acquire, "record r.toml -o a --durration 3", "--duration"),
        (acquire, "record r.toml -o a --pasive", "--passive"),
        (acquire, "record r.toml -o a --tarck=b", "--track"),
        (acquire, "record r.toml -o a --unsupervised", "--unsupervised-drives"),
        (acquire, "import a --robto r.toml", "--robot"),
        (acquire, "import a -o=b --over-write", "--overwrite"),
        (acquire, "inof a.mcap", "info"),
        (acquire, "recrod r.toml", "record"),
        (identify, "fit a --jsn b", "--json"),
        (identify, "fit a --cutoff 3", "--cutoff-hz"),
        (identify, "simulat r.toml", "simulate"),
        (identify, "fit a --method lsw", ""),
        # words of something else
        (acquire, "record r.toml -o a --overwrite", ""),
        (acquire, "record r.toml -o a --output-folder b", ""),
        (acquire, "scan --interface virtual --channel c --duration 3", ""),
        (acquire, "record r.toml records.mcap -o a", ""),
        (identify, "fit a --period 3", ""),
        (identify, "fit a.mcap b -o export", ""),
        (identify, "plot a", ""),
        (identify, "excite r.toml -o a --cutoff-hz -3", ""),
    ],
)
def test_suggestion_only_for_near_match(program, typed, meant, capsys):
    with pytest.raises(SystemExit):
        program(typed.split())
    said = capsys.readouterr().err.strip()
    assert said.partition(": did you mean ")[2] == (f"{meant}?" if meant else "")


def test_method_may_be_in_capitals():
    assert IDENTIFY.parser("fit").parse_args(["fit", "a.mcap", "--method", "IV"]).method == "iv"


def test_shell_completion(capsys, monkeypatch):
    pytest.importorskip("shtab")
    for program, status, words in (
        (
            identify,
            0,
            ["_fit___method_choices=(ols wls iv)", "_fit_pos_0_COMPGEN=_shtab_compgen_files"],
        ),
        (acquire, 0, ["_import_option_strings=(", "_check_pos_0_COMPGEN=_shtab_compgen_files"]),
        (
            identify,
            2,
            [
                "robot-identify: error: --print-completion needs shtab. Run: pip install "
                "'robot-idim[completion]'\n"
            ],
        ),
    ):
        if status:
            monkeypatch.setitem(sys.modules, "shtab", None)
        with pytest.raises(SystemExit) as stopped:
            program(["--print-completion", "bash"])
        assert stopped.value.code == status
        printed = "".join(capsys.readouterr())
        assert all(word in printed for word in words)


def test_swapped_arguments_are_reported(capsys):
    others = str(REPLAY / "tx40" / "session.mcap")
    for command in ([SESSION, FIT], [SESSION, others, FIT]):
        assert identify(["validate", *map(str, command)]) == 1
        right = " ".join(map(str, [FIT, *command[:-1]]))
        assert capsys.readouterr().err == (
            f"robot-identify: {SESSION}: is not a fit. Pass the fit first: `robot-identify "
            f"validate {right}`.\n"
        )


def test_urdf_as_robot_toml_is_reported(tmp_path, monkeypatch, capsys):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "arm.urdf").write_text('<?xml version="1.0"?><robot name="a"/>')
    monkeypatch.chdir(tmp_path)
    told = (
        "folder/arm.urdf: this is a URDF, not a robot.toml. Make a robot.toml from it: "
        "`robot-identify init folder/arm.urdf -o robot.toml`."
    )
    for program, command in (
        (acquire, "check"),
        (identify, f"fit {SESSION} --robot"),
        (acquire, "import a -o b --robot"),
    ):
        assert program([*command.split(), "folder/arm.urdf"]) == 1
        said = capsys.readouterr().err
        assert said.endswith(f": {told}\n")
        assert said.count("\n") == 1


def test_emulate_refuses_virtual_bus(capsys):
    assert acquire(["emulate", str(SCARA), "--duration", "0.1"]) == 1
    assert capsys.readouterr().err.startswith(
        f"robot-acquire: {SCARA}: bus.interface = 'virtual': other programs cannot use this "
        "bus: "
        "expected udp_multicast or "
    )
