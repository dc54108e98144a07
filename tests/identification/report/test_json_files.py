"""JSON files: every key of earlier versions is there, each file has the version of its format."""

import json

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from fits_of_records import iv_of, ls_of, signals_of

from identification.commands import main
from identification.methods import fit_file, stored_beta
from identification.report import FitFile, ValidationFile, read_fit, write_json
from identification.study import base_file, study_truth

SCARA = REPLAY / "scara" / "session.mcap"


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """Files of two fits of one recording, by method."""
    folder, files = tmp_path_factory.mktemp("fits"), {}
    for method, fit in (("iv", iv_of(SCARA)), ("wls", ls_of(SCARA))):
        files[method] = folder / f"{method}.json"
        write_json(files[method], fit_file(fit))
    return files


def keys(value, place="") -> set[str]:
    """All keys of JSON content as paths; those of a list's elements under one."""
    if isinstance(value, dict):
        return {p for key, x in value.items() for p in (f"{place}.{key}", *keys(x, f"{place}.{key}"))}
    return {p for x in value for p in keys(x, f"{place}[]")} if isinstance(value, list) else set()


def lasting_keys(earlier) -> set[str]:
    """Those of a file of an earlier version but its report, which is printed, a replaced deviation, and a test that went."""
    went = (".report", ".parameters[].sigma_hac", ".instrument_tests.dwh_")
    return {key for key in keys(earlier) if not key.startswith(went)}


def test_a_fit_keeps_the_keys_of_earlier_versions(fits):
    earlier = json.loads((REPLAY / "scara" / "fit.json").read_text())
    now = json.loads(fits["iv"].read_text())
    assert earlier["method"] == now["method"] == "iv"
    assert lasting_keys(earlier) <= keys(now)
    without = json.loads(fits["wls"].read_text())
    only_iv = {"reason", "pass_returned", "start", "reference", "controller", "iterations", "instrument_tests"}
    only_iv |= {"contrast_half_widths", "rows_used_percent", "saturated_percent", "direct_model"}
    assert set(now) - set(without) == only_iv


def test_a_fit_is_read_back_as_it_was_written(fits):
    fit = iv_of(SCARA)
    written = read_fit(fits["iv"])
    assert [p.value for p in written.parameters] == list(fit.estimate.beta)
    assert [p.sigma for p in written.parameters] == list(fit.estimate.sigma)
    assert [p.low for p in written.parameters] == list(fit.intervals.low)
    assert [p.high for p in written.parameters] == list(fit.intervals.high)
    assert written.covariance.names == [p.name for p in written.parameters]
    np.testing.assert_array_equal(written.covariance.values, fit.intervals.covariance)
    np.testing.assert_allclose(np.sqrt(np.diag(written.covariance.values)), fit.intervals.sigma, rtol=1e-12)
    assert [p.half for p in written.parameters] == pytest.approx(list(fit.intervals.half), rel=1e-9)
    assert written == msgspec.json.decode(msgspec.json.encode(written), type=FitFile)
    made = fit_file(fit)
    for name in made.__struct_fields__:
        if name not in ("essential", "instrument_tests", "trust", "iterations"):  # numbers of these may be null
            assert getattr(made, name) == getattr(written, name), name


def test_the_schema_of_a_fit_is_that_of_its_file(fits):
    schema = msgspec.json.schema(FitFile)
    fields = schema["$defs"]["FitFile"]
    for method, path in fits.items():
        content = json.loads(path.read_text())
        assert set(fields["required"]) <= set(content) <= set(fields["properties"]), method
    assert fields["properties"]["status"]["enum"] == [
        "converged", "diverged", "max_iterations", "not_confirmed", "solved"
    ]  # fmt: skip
    json.dumps(schema)


def test_every_file_has_a_format_and_its_keys(fits, tmp_path, capsys):
    robot, out = REPLAY / "scara" / "robot.toml", tmp_path / "out.json"
    study = ["study", robot, "--runs", "1", "--duration-s", "2"]
    for kind, expected, command in (
        (FitFile, set(), ["fit", SCARA, "--all", "--method", "wls"]),
        (ValidationFile, set(), ["validate", fits["iv"], SCARA]),
        (dict, {"a", "b", "differences"}, ["compare", fits["iv"], fits["wls"]]),
        (dict, {"robot", "joint_names", "parameters"}, ["base", robot]),
        (dict, {"study", "parameters", "true", "summaries", "runs"}, study),
    ):
        capsys.readouterr()
        assert main([str(word) for word in [*command, "--json", out]]) == 0
        msgspec.json.decode(out.read_bytes(), type=kind)
        content = json.loads(out.read_text())
        assert content["format"] == 1
        assert not expected or set(content) == {"format", *expected}
        assert "report" not in content


def test_known_values_are_a_file_of_their_own(tmp_path):
    robot = signals_of(SCARA).robot
    base, true = study_truth(robot)
    write_json(tmp_path / "truth.json", base_file(base, robot, true))
    earlier = json.loads((REPLAY / "scara" / "truth.json").read_text())
    now = json.loads((tmp_path / "truth.json").read_text())
    assert lasting_keys(earlier) <= keys(now)
    assert now["parameters"] == earlier["parameters"]
    assert now["format"] == 1
    assert stored_beta(read_fit(tmp_path / "truth.json"), base, "truth.json").tolist() == list(true)


def test_a_comparison_holds_the_differences(fits, tmp_path):
    out = tmp_path / "both.json"
    assert main(["compare", str(fits["iv"]), str(fits["wls"]), "--json", str(out)]) == 0
    content = json.loads(out.read_text())
    a, b = (json.loads(fits[name].read_text())["parameters"] for name in ("iv", "wls"))
    assert (content["a"], content["b"]) == ("iv", "wls")
    for d, x, y in zip(content["differences"], a, b, strict=True):
        assert (d["name"], d["a"]["value"], d["b"]["value"]) == (x["name"], x["value"], y["value"])
        assert d["off"] == x["value"] - y["value"]
