"""The house: rooms with a face, few files and tests, files that stay small, a command
line that starts at once.

That arrows between rooms run down, that rooms are entered by their faces and that heavy packages
have one owner each is held by the contracts in pyproject.toml (`lint-imports`).
"""

import ast
import re
import subprocess
import sys
import tomllib

import pytest
from conftest import PROGRAMS, ROOT
from slow_tests import listed
from wordings import TABLE, table

PACKAGES = ("acquisition", "identification")
ROOMS = sorted(
    path
    for package in PACKAGES
    for path in (ROOT / package).iterdir()
    if (path / "__init__.py").exists()
)
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
MOST_FILES, MOST_LINES, MOST_LINES_OF_A_FACE = 15, 343, 10


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: f"{room.parent.name}.{room.name}")
def test_subpackage_has_docstring_and_few_files(room):
    face = ast.parse((room / "__init__.py").read_text())
    told = ast.get_docstring(face)
    assert len(told.splitlines()) <= MOST_LINES_OF_A_FACE
    assert "owns" in told, "what is its own"
    assert "may use" in " ".join(told.split()), "what it may use"
    shown = [n for n in ast.walk(face) if isinstance(n, ast.ImportFrom)]
    assert shown
    # for names that are imported when they are used
    others = ("typing", "lazy", "acquisition.lazy")
    assert all(n.level == 1 or n.module in others for n in shown), (
        "a face shows what its own room has"
    )
    files = {path.stem for path in room.glob("*.py")} - {"__init__"}
    if room.name == "commands":  # one file per command, and those that commands share
        files -= set(command_files(room.parent.name))
    assert len(files) <= MOST_FILES


HEAVY = "numpy scipy pinocchio rerun mcap rosbags pyarrow joblib rich can canopen msgspec"


def commands_of(package):
    (choices,) = (
        action.choices for action in PROGRAMS[package].parser()._actions if action.choices
    )
    return list(choices)


def command_files(package):
    """By the file of each command its name."""
    commands = PROGRAMS[package].parser(*PROGRAMS[package].commands)
    (choices,) = (action.choices for action in commands._actions if action.choices)
    return {
        command.get_default("run").__module__.rsplit(".", 1)[-1]: name
        for name, command in choices.items()
    }


@pytest.mark.parametrize("package", PACKAGES)
def test_command_has_name_of_its_file(package):
    assert [file.rstrip("_") for file in command_files(package)] == commands_of(package)


def test_every_subpackage_is_in_contracts():
    with (ROOT / "pyproject.toml").open("rb") as file:
        contracts = tomllib.load(file)["tool"]["importlinter"]["contracts"]
    layers = {
        f"{c['containers'][0]}.{name}"
        for c in contracts
        if c["type"] == "layers"
        for name in c["layers"]
    }
    faces = {c["allowed_importers"][0] for c in contracts if c["type"] == "protected"}
    rooms = {f"{room.parent.name}.{room.name}" for room in ROOMS}
    assert faces == rooms
    assert rooms <= layers


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: f"{room.parent.name}.{room.name}")
def test_every_subpackage_has_tests(room):
    assert list((ROOT / "tests" / room.parent.name / room.name).glob("test_*.py"))


def test_no_file_imports_tests():
    """What two need stands in a helper beside them, which is imported by its name alone."""
    names = [path.stem for path in TESTS]
    assert {name for name in names if names.count(name) > 1} == set()
    imports = re.compile(r"^\s*(?:from|import) (test_\w+)", re.MULTILINE)
    assert {found for path in TESTS for found in imports.findall(path.read_text())} & set(
        names
    ) == set()


def code_lines(source):
    """Return the number of lines that hold code: no docstrings, comments or blank lines."""
    texts = {
        line
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)
        for line in range(node.lineno, node.end_lineno + 1)
    }
    return sum(
        not (line.isspace() or not line or line.lstrip().startswith("#")) and number not in texts
        for number, line in enumerate(source.splitlines(), 1)
    )


def test_files_stay_small():
    lengths = {str(path.relative_to(ROOT)): code_lines(path.read_text()) for path in FILES}
    assert {name: n for name, n in lengths.items() if n > MOST_LINES} == {}


def printed(code):
    """By Python that loads nothing else."""
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    ).stdout


@pytest.mark.parametrize("package", PACKAGES)
def test_help_loads_nothing_heavy(package):
    """That of the program and of each command."""
    helps = [["--help"], *([name, "--help"] for name in commands_of(package))]
    code = (
        f"import sys\nfrom {package}.commands import main\n"
        f"for arguments in {helps}:\n try: main(arguments)\n except SystemExit: pass\n"
        f"print(set('{HEAVY}'.split()) & set(sys.modules))"
    )
    out = printed(code)
    assert out.splitlines()[-1] == "set()"
    assert out.count("usage: robot-") == len(helps)


def test_fit_and_simulation_avoid_slow_scipy(tmp_path):
    """`scipy.signal` imports `scipy.stats`, which alone takes longer than a fit."""
    code = (
        "import sys, identification.methods\nfrom identification.commands import main\n"
        f"command = 'simulate {ROOT}/replay_data/emps/robot.toml -o {tmp_path}/made.mcap'\n"
        "options = ['--duration-s', '0.2', '--effort-coloured-percent', '1']\n"
        "assert main([*command.split(), *options]) == 0\n"
        "print({'scipy.stats', 'scipy.signal', 'scipy.interpolate'} & set(sys.modules))"
    )
    assert printed(code).splitlines()[-1] == "set()"


MOST_PARAMETERS = 6
# what users call with arrays: no record of options between
# those of a public interface, all by keyword
PLAIN_KEYWORDS = {
    "identification/notebook.py fit",
    "identification/notebook.py fit_log",
    "acquisition/errors.py __init__",
}


def parameters(function):
    """Names of a function's parameters, `self` and `cls` apart."""
    a = function.args
    names = [
        parameter.arg
        for parameter in (*a.posonlyargs, *a.args, a.vararg, *a.kwonlyargs, a.kwarg)
        if parameter
    ]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def test_functions_take_few_parameters():
    long = {
        f"{path.relative_to(ROOT)} {node.name}"
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and len(parameters(node)) > MOST_PARAMETERS
    }
    assert long == PLAIN_KEYWORDS


def test_slow_list_names_tests():
    for name in listed() - {""}:
        file, _, function = name.split("[")[0].partition("::")
        assert f"def {function}(" in (ROOT / file).read_text(), name


def test_wordings_match_code():
    assert TABLE.read_text(encoding="utf-8") == table(), (
        "read what changed, then `python tests/wordings.py`"
    )
