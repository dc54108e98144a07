"""Models of fits as they come out: with a law that was found, without terms that were left out."""

import json
import tomllib

import numpy as np
import pytest
from command_runs import refused, run
from conftest import REPLAY, robot_named
from friction_models import USUAL, described, simulated

from acquisition.robot import load_robot, robot_from_files
from identification import load
from identification.errors import BadInputError
from identification.estimation import consistent_parameters
from identification.model import (
    InverseModel,
    base_parameters,
    described_parameters,
    physical_parameters,
)
from identification.study import write_signals

FIT = json.loads((REPLAY / "tx40" / "fit.json").read_text())
MADE = FIT["description"]["robot.toml"]
BEFORE, REST = MADE.split("[controller]\n")
LAW = FIT["law"]["controller"]


def with_controller(table: str, place: str = "") -> dict:
    """The fit of the TX40 with another [controller], at its place or at the `end`."""
    assert "structure" not in tomllib.loads(MADE)["controller"]
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
def test_estimated_law_fills_empty_table(table, place, bandwidth_hz, tmp_path, capsys):
    fit, toml = tmp_path / "fit.json", tmp_path / "new.toml"
    fit.write_text(json.dumps(with_controller(table, place)))
    assert run(capsys, "export", fit, "--toml", toml)[0] == 0
    found = tomllib.loads(toml.read_text())["controller"]
    assert found == LAW | ({"bandwidth_hz": bandwidth_hz} if bandwidth_hz else {})
    assert load_robot(toml).controller.structure == LAW["structure"]
    assert all(line in toml.read_text() for line in table.splitlines())
    load(fit).export(toml=toml)
    assert tomllib.loads(toml.read_text())["controller"] == found


@pytest.mark.parametrize("line", ["controller = {}\n", "controller.bandwidth_hz = 8.0\n"])
def test_unsupported_law_refused(line, tmp_path, capsys):
    fit, toml, content = tmp_path / "fit.json", tmp_path / "new.toml", with_controller("")
    content["description"]["robot.toml"] = line + content["description"]["robot.toml"]
    fit.write_text(json.dumps(content))
    assert "[controller]: cannot be replaced line by line. Write a line [controller]" in refused(
        capsys, "export", fit, "--toml", toml
    )
    assert not toml.exists()


FAR = ["viscous", "coulomb", "stribeck"]  # at a speed far beyond the motion: Coulomb friction
LOAD = ["viscous", "coulomb", "load"]


def recorded(folder, terms, more=""):
    """A recording of the SCARA whose description has these terms; those without a value in
    `more` do not act.
    """
    robot = described("scara", terms, more)
    text = robot.files["robot.toml"].decode().replace("deg_s = 20\n", "deg_s = 20000\n")
    signals = simulated(described("scara", [USUAL[:2]] * 2) if not more else robot, 3).sources[0]
    write_signals(folder / "log.mcap", signals, source="simulated")
    (folder / "robot.toml").write_text(text)
    return folder / "log.mcap", robot_from_files({"robot.toml": text.encode()}, "scara.toml")


@pytest.mark.parametrize(
    ("terms", "more", "left_out", "method"),
    [
        ([LOAD, LOAD], "", {"mu1", "mu2"}, "wls"),
        ([LOAD, LOAD], "mu2 = 0.3\n", {"mu1"}, "iv"),
        ([FAR, USUAL[:2]], "", {"Fs1"}, "wls"),
    ],
)
def test_dropped_terms_are_zero_in_models(terms, more, left_out, method, tmp_path, capsys):
    log, robot = recorded(tmp_path, terms, more)
    model = InverseModel(robot)
    base = base_parameters(model)
    true = dict(zip(base.names, described_parameters(model, base), strict=True))
    plain, whole = tmp_path / "plain.json", tmp_path / "whole.json"
    command = ["fit", log, "--robot", tmp_path / "robot.toml", "--method", method]
    assert run(capsys, *command, "--consistent", "--json", whole)[0] == 0
    content = json.loads(whole.read_text())
    assert set(base.names) - {p["name"] for p in content["parameters"]} == left_out
    del content["consistent"], content["standard_parameters"]
    plain.write_text(json.dumps(content))
    for fit in (plain, whole):
        outputs = "--toml", tmp_path / "new.toml", "--mjcf", tmp_path / "new.xml"
        assert run(capsys, "export", fit, *outputs)[0] == 0
        found = load_robot(tmp_path / "new.toml").parameters
        assert {found[name] for name in left_out} == {0.0}
        for name, value in zip(base.names, base.K @ [found[n] for n in model.names], strict=True):
            assert value == pytest.approx(true[name], rel=0.05, abs=0.03)


def test_model_without_terms_matches_plain_robot():
    """The nearest body of an estimate far from any, so that conditions move it."""
    without, having = (InverseModel(described("scara", [terms] * 2)) for terms in (USUAL[:2], LOAD))
    base = base_parameters(without)
    beta = base.K @ physical_parameters(without).start
    beta[[base.names.index(name) for name in ("ZZ2", "Fc1")]] = -0.05, -0.01
    C = np.diag((0.1 * np.abs(beta) + 0.01) ** 2)
    expected = consistent_parameters(beta, C, base.K, physical_parameters(without))
    K = base_parameters(having).without({"mu1", "mu2"}).K
    found = consistent_parameters(beta, C, K, physical_parameters(having))
    assert expected.chi_squared > 1.0
    chi = dict(zip(having.names, found.chi, strict=True))
    assert (chi.pop("mu1"), chi.pop("mu2")) == (0.0, 0.0)
    assert tuple(chi) == without.names
    np.testing.assert_allclose([*chi.values()], expected.chi, rtol=1e-6, atol=1e-9)


def test_incomplete_covariance_refused(tmp_path):
    content = json.loads((REPLAY / "scara" / "fit.json").read_text())
    covariance = content["covariance"]
    del covariance["names"][0]
    covariance["values"] = [row[1:] for row in covariance["values"][1:]]
    content.pop("standard_parameters", None)
    (tmp_path / "fit.json").write_text(json.dumps(content))
    with pytest.raises(BadInputError) as caught:
        load(tmp_path / "fit.json").export(toml=tmp_path / "new.toml")
    first = base_parameters(InverseModel(robot_named("scara"))).names[0]
    assert (caught.value.key, caught.value.text) == ("covariance", f"lacks {first}")
