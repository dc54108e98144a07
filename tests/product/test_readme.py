"""The READMEs: every command is one the programs take and those without
hardware run; links, pictures.
"""

import re
import shlex
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from conftest import ACQUIRE, IDENTIFY, REPLAY, ROOT
from urdfs import TWO_TURNING

from acquisition.recording import read_recording

FORMATS = ROOT / "acquisition" / "docs" / "import.md"
START, ROBOT, READING = (
    ROOT / "identification" / "docs" / f"{page}.md" for page in ("start", "robot", "reading-a-fit")
)
FOLDERS = ("acquisition", "identification", "replay_data", "tests")
BESIDE = [*ROOT.glob("*.md"), *ROOT.glob(".github/*.md")]
ALL = [*BESIDE, *sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.md"))]
TEXT = {path: path.read_text() for path in ALL}
# In blocks and in sentences. What follows " #" is a remark.
COMMAND = re.compile(
    r"^ {4,}(robot-(?:acquire|identify) .*)$|`(robot-(?:acquire|identify) [a-z]+ [^`]*)`",
    re.MULTILINE,
)
COMMANDS = list(
    dict.fromkeys(
        (found[1] or found[2]).split(" #")[0].strip()
        for path, text in TEXT.items()
        if not path.name.endswith("reference.md")  # whose words are those of the help
        for found in COMMAND.finditer(text)
    )
)
PROGRAMS = {program.name: program for program in (ACQUIRE, IDENTIFY)}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_parses(command):
    program, *arguments = shlex.split(command)
    assert callable(PROGRAMS[program].parser(arguments[0]).parse_args(arguments).run)


def masked(line):
    """A line without its numbers, and its numbers."""
    number = r"(?<![A-Za-z0-9])[0-9][0-9.e-]*"
    return re.sub(number, "x", line), [float(x) for x in re.findall(number, line)]


def test_commands_without_hardware_run(tmp_path, monkeypatch, capsys):
    """On the small robot; then the fits of both robots that the pages show."""
    for name in ("log.mcap", "other.mcap"):
        shutil.copy(REPLAY / "scara" / "session.mcap", tmp_path / name)
    for name in ("robot.toml", "corrected.toml"):
        shutil.copy(REPLAY / "scara" / "robot.toml", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    # Fits come before the commands that read them.
    later, run = (
        [command for command in COMMANDS if command.split()[1] in ("compare", "validate")],
        set(),
    )
    for command in [command for command in COMMANDS if command not in later] + later:
        program, *arguments = shlex.split(command)
        runs = {"base", "info", "fit", "validate", "import", "export", "view", "compare"}
        made_elsewhere = {"map.toml", "arm.urdf"} & {*arguments}
        if arguments[0] in runs and Path(arguments[1]).exists() and not made_elsewhere:
            assert PROGRAMS[program].main(arguments) == 0, command
            run.add(arguments[0])
    assert run == runs
    for page, robot in ((START, "scara"), (READING, "tx40")):
        capsys.readouterr()
        assert IDENTIFY.main(["fit", str(REPLAY / robot / "session.mcap")]) == 0
        shown = re.split(r"^    robot-identify fit .*\n\n", TEXT[page], flags=re.MULTILINE)[1]
        block = re.match(r"(    .*\n|\n)+", shown)[0].partition("    ...\n")[0]
        lines = [line for line in block.splitlines() if line]
        assert lines[0].startswith(f"    {robot.upper()}: ")
        assert len(lines) > 10
        out = capsys.readouterr().out
        printed = (line for line in out.splitlines() if line and "──" not in line)
        # The beginning of the report.
        for line, now in zip(lines, printed, strict=False):
            (words, numbers), (words_now, numbers_now) = masked(line.strip()), masked(now.strip())
            assert words == words_now
            assert numbers_now == pytest.approx(numbers, rel=0.05)


def test_shown_robot_toml_is_valid(tmp_path, capsys):
    """The description shown, of one joint of a URDF of two, is read, and has base parameters."""
    (shown,) = re.findall(r"^```toml\n(.*?)^```", TEXT[ROBOT], flags=re.MULTILINE | re.DOTALL)
    (tmp_path / "robot.toml").write_text(shown)
    (tmp_path / tomllib.loads(shown)["urdf"]).write_text(TWO_TURNING)
    assert IDENTIFY.main(["base", str(tmp_path / "robot.toml")]) == 0
    assert "ZZ1R" in capsys.readouterr().out


def test_shown_map_fits_named_columns(tmp_path):
    shown, header = (
        re.search(pattern, TEXT[FORMATS], flags=re.MULTILINE | re.DOTALL)[1]
        for pattern in (r"^```toml\n(.*?)^```", r"header `(t,[^`]*)`")
    )
    (tmp_path / "map.toml").write_text(shown)
    values = np.arange(7 * 200.0).reshape(200, 7) * 1e-5 * np.arange(1, 8)
    values[:, 0] = np.arange(200) / 100
    np.savetxt(tmp_path / "log.csv", values, delimiter=",", header=header, comments="")
    out, robot = str(tmp_path / "log.mcap"), str(REPLAY / "scara" / "robot.toml")
    options = ["--robot", robot, "--map", str(tmp_path / "map.toml"), "-o", out]
    assert ACQUIRE.main(["import", str(tmp_path / "log.csv"), *options]) == 0
    samples = read_recording(tmp_path / "log.mcap").samples
    for name, columns in (
        ("position", slice(1, 3)),
        ("reference", slice(3, 5)),
        ("effort", slice(5, 7)),
    ):
        np.testing.assert_array_equal(samples[name], values[:, columns])


def anchors(text):
    """Anchors of the headings as GitHub makes them."""
    for heading in re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE):
        yield re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("readme", ALL, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files(readme):
    links = re.findall(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)", TEXT[readme])
    for place, anchor in links:
        file = (readme.parent / place).resolve() if place else readme
        file = file / "README.md" if file.is_dir() else file
        assert file.exists(), place
        assert not anchor or anchor in anchors(file.read_text()), f"{place}#{anchor}"
