"""Models of fits as they come out: with a law that was found."""

import json
import tomllib

import pytest
from command_runs import refused, run
from conftest import REPLAY

from acquisition.robot import load_robot
from identification import read_fit

FIT = json.loads((REPLAY / "tx40" / "fit.json").read_text())
MADE = FIT["description"]["robot.toml"]
BEFORE, REST = MADE.split("[controller]\n")
LAW = FIT["law"]["controller"]


def with_controller(table: str, place: str = "") -> dict:
    """The fit of the TX40 with another [controller], at its place or at the `end`."""
    others = tomllib.loads(MADE)
    assert "structure" not in others["controller"]
    tables = REST[REST.index("\n[") :]
    text = f"{BEFORE}{tables}\n{table}" if place == "end" else f"{BEFORE}{table}{tables}"
    return {**FIT, "description": {**FIT["description"], "robot.toml": text}}


AS_INIT = """[controller]
# bandwidth_hz = ... # FILL IN: of the position loop
# structure = "cascade_p_pi" # or pd
"""


@pytest.mark.parametrize(
    ("table", "place", "bandwidth_hz"),
    [
        (AS_INIT, "", None),  # as init writes it
        (AS_INIT, "end", None),
        ("", "", None),
        ("[controller]", "end", None),  # the last line, without an end
        ("  [ controller ]  # of the arm\nbandwidth_hz = 8.0\n", "", 8.0),
        ("[controller]\r\nbandwidth_hz = 8.0\r\n", "", 8.0),
    ],
)
def test_a_found_law_is_written_into_a_table_that_may_be_empty(
    table, place, bandwidth_hz, tmp_path, capsys
):
    fit, toml = tmp_path / "fit.json", tmp_path / "new.toml"
    fit.write_text(json.dumps(with_controller(table, place)))
    assert run(capsys, "export", fit, "--toml", toml)[0] == 0
    found = tomllib.loads(toml.read_text())["controller"]
    assert found == LAW | ({"bandwidth_hz": bandwidth_hz} if bandwidth_hz else {})
    assert load_robot(toml).controller.structure == LAW["structure"]
    assert all(line in toml.read_text() for line in table.splitlines())
    read_fit(fit).export(toml=toml)
    assert tomllib.loads(toml.read_text())["controller"] == found


@pytest.mark.parametrize("line", ["controller = {}\n", "controller.bandwidth_hz = 8.0\n"])
def test_a_law_for_which_there_is_no_line_is_refused(line, tmp_path, capsys):
    fit, toml, content = tmp_path / "fit.json", tmp_path / "new.toml", with_controller("")
    content["description"]["robot.toml"] = line + content["description"]["robot.toml"]
    fit.write_text(json.dumps(content))
    assert "[controller]: cannot be replaced line by line: expected a line [controller]" in refused(
        capsys, "export", fit, "--toml", toml
    )
    assert not toml.exists()
