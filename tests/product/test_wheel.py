"""What the built wheel holds: programs and demo work where this checkout is not."""

import configparser
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from conftest import REPLAY, ROOT

import acquisition
import identification

pytest.importorskip(
    "hatchling", reason="no hatchling here to build a wheel with: pip install -e '.[test]'"
)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The wheel as pip would unpack it, in a folder of its own."""
    folder = tmp_path_factory.mktemp("wheel")
    build = f"import hatchling.build; hatchling.build.build_wheel({str(folder)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def test_wheel_has_programs_and_demo(installed, tmp_path):
    """Without `site` no installation of this checkout is found.

    The demo reads its robot before it makes its folder.
    """
    (entries,) = installed.glob("*.dist-info/entry_points.txt")
    scripts = configparser.ConfigParser()
    scripts.read(entries)
    assert dict(scripts["console_scripts"]) == {
        "robot-acquire": "acquisition.commands:main",
        "robot-identify": "identification.commands:main",
    }
    code = (
        "import contextlib, acquisition.__main__ as a, identification.__main__ as i\n"
        "print(a.__file__, i.__file__)\n"
        "for robot in ('scara', 'tx40'): assert i.main(['demo', '--robot', robot, '--out', "
        "'/dev/null']) == 1\n"
        "with contextlib.suppress(SystemExit): a.main(['--help'])\n"
    )
    packages = [path for path in sys.path if "site-packages" in path]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(installed), *packages])}
    done = subprocess.run(
        [sys.executable, "-S", "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (
        done.stderr
        == 2
        * "robot-identify: /dev/null: the folder cannot be created (File exists). Choose another "
        "folder.\n"
    )
    assert done.stdout.startswith(
        f"{installed}/acquisition/__main__.py {installed}/identification/__main__.py\n"
    )
    assert "usage: robot-acquire" in done.stdout


def test_type_checker_sees_editable_install(tmp_path):
    """A user's script, checked in a folder and an environment that know of this checkout by
    the installation alone.
    """
    build = f"import hatchling.build; hatchling.build.build_editable({str(tmp_path)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=ROOT, check=True, capture_output=True)
    subprocess.run(
        [sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True
    )
    (packages,) = (tmp_path / "venv").glob("lib/python3*/site-packages")
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    (packages / "borrowed.pth").write_text(
        "\n".join(path for path in sys.path if "site-packages" in path)
    )
    shutil.copy(Path(__file__).with_name("user_script.py"), tmp_path)
    names = [
        f"{package.__name__}.{name}"
        for package in (acquisition, identification)
        for name in package.__all__
    ]
    (tmp_path / "names.py").write_text(
        "\n".join(["import acquisition", "import identification", *names, ""])
    )
    words = "-m mypy --strict --python-executable venv/bin/python user_script.py names.py"
    environment = {
        name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")
    }
    checked = subprocess.run(
        [sys.executable, *words.split()],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.stdout == "Success: no issues found in 2 source files\n"


def test_wheel_has_robots_and_no_tests(installed):
    packages = {"acquisition", "identification"}
    assert {path.parent.name for path in installed.rglob("py.typed")} == packages
    for name in ("scara", "tx40"):
        inside = installed / "identification" / "robots" / name / "robot.toml"
        assert inside.read_bytes() == (REPLAY / name / "robot.toml").read_bytes()
    assert {path.name for path in installed.iterdir() if path.suffix != ".dist-info"} == packages
