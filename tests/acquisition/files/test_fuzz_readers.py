"""Whatever stands in a file, a reader returns or raises `RobotIdimError` in one line;
nothing else gets out.
"""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from conftest import REPLAY, robot_named
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from acquisition.errors import RobotIdimError
from acquisition.importing import import_tables
from acquisition.recording import read_recording
from acquisition.robot import robot_from_files

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "100"))
FUZZ = settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
TOMLS = [path.read_text() for path in sorted(REPLAY.glob("*/*.toml"))]
VALUES = st.sampled_from(
    f"""0 -1 1e308 -1e-320 nan inf {"9" * 30} true 1979-05-27 "" "x" "rad" "A" "deg" "m" []
    [[]] {{}} {{a=1}} [1,2] [0,0,0] [nan] [1e300,1e300] [[0,0],[0,0]]
    [[1e300,1],[1,1e300]]""".split()
)


@contextlib.contextmanager
def one_line_or_fine() -> Iterator[None]:
    try:
        yield
    except RobotIdimError as error:
        text = str(error)
    else:
        return
    assert text.isprintable()
    assert ": " in text


@st.composite
def changed_toml(draw: st.DrawFn) -> str:
    """A description with lines dropped, doubled or moved, and values exchanged."""
    lines = draw(st.sampled_from(TOMLS)).splitlines()
    for _ in range(draw(st.integers(1, 4))):
        k = draw(st.integers(0, len(lines) - 1))
        key = lines[k].partition("=")[0]
        change = draw(st.sampled_from(["drop", "double", "move", "value", "text"]))
        if change == "drop" and len(lines) > 1:
            del lines[k]
        elif change == "double":
            lines.insert(k, lines[k])
        elif change == "move":
            lines.insert(draw(st.integers(0, len(lines) - 1)), lines[k])
        elif change == "value" and "=" in lines[k]:
            lines[k] = f"{key}= {draw(VALUES)}"
        else:
            lines[k] = draw(st.text(max_size=20))
    return "\n".join(lines)


def use_robot(text: str) -> None:
    robot = robot_from_files({"robot.toml": text.encode("utf-8", "surrogatepass")}, "robot.toml")
    assert robot.n == len(robot.effort_units)
    assert np.isfinite(robot.R).all()
    assert robot.files


def use_map(text: str) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "map.toml"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        import_tables([path.with_name("none.csv")], EMPS, path, path.with_name("out.mcap"))


@pytest.mark.parametrize("use", [use_robot, use_map])
@FUZZ
@given(text=changed_toml() | st.text(alphabet=st.sampled_from("[]{}=.,\"'\n\\ #ab1e-_:T")))
def test_changed_descriptions(use: Callable[[str], None], text: str) -> None:
    with one_line_or_fine():
        use(text)


@FUZZ
@given(
    text=changed_toml(),
    numbers=st.lists(st.lists(st.floats(width=32), min_size=5, max_size=5), min_size=1, max_size=6),
)
def test_any_import(tmp_path: Path, text: str, numbers: list[list[float]]) -> None:
    lines = [",".join(map(str, row)) for row in numbers]
    (tmp_path / "a.csv").write_text("\n".join(["t,qm,qg,vir,Joint_1", *lines]))
    (tmp_path / "map.toml").write_bytes(text.encode("utf-8", "surrogatepass"))
    with one_line_or_fine():
        result = import_tables(
            [tmp_path / "a.csv"] * 2, EMPS, tmp_path / "map.toml", tmp_path / "out.mcap"
        )
        assert read_recording(result.out).sample_rate_hz > 0


EMPS = robot_named("emps")
