"""JSON files: every key of earlier versions is there, each file has the version of its format and the report, and is typed."""

import json

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from fits_of_records import iv_of, ls_of, signals_of

from identification.commands import main
from identification.methods.comparison import ComparisonFile
from identification.methods.fit_files import FitFile, ValidationFile
from identification.report import fit_document, fit_file, fit_schema, read_fit, write_json
from identification.report.document import FORMAT
from identification.study.study_report import BaseFile, StudyFile

SCARA = REPLAY / "scara" / "session.mcap"


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """Files of two fits of one recording, by method."""
    folder, signals = tmp_path_factory.mktemp("fits"), signals_of(SCARA)
    files = {}
    for method, fit in (("iv", iv_of(SCARA)), ("wls", ls_of(SCARA))):
        files[method] = folder / f"{method}.json"
        write_json(files[method], fit_file(signals, fit, fit_document(signals, fit)))
    return files


def keys(value, place="") -> set[str]:
    """All keys of JSON content as paths; those of a list's elements under one."""
    if isinstance(value, dict):
        return {p for key, x in value.items() for p in (f"{place}.{key}", *keys(x, f"{place}.{key}"))}
    return {p for x in value for p in keys(x, f"{place}[]")} if isinstance(value, list) else set()


def test_a_fit_keeps_the_keys_of_earlier_versions(fits):
    earlier = json.loads((REPLAY / "scara" / "fit.json").read_text())
    now = json.loads(fits["iv"].read_text())
    assert earlier["method"] == now["method"] == "iv"
    assert keys(earlier) - {".parameters[].sigma_hac"} <= keys(now)  # the interval is in its place
    without = json.loads(fits["wls"].read_text())
    only_iv = {"reason", "pass_returned", "start", "reference", "controller", "iterations", "instrument_tests"}
    only_iv |= {"contrast_half_widths", "rows_used_percent", "saturated_percent", "direct_model"}
    assert set(now) - set(without) == only_iv


def test_a_fit_is_read_back_as_it_was_written(fits):
    fit = iv_of(SCARA)
    written = msgspec.json.decode(fits["iv"].read_bytes(), type=FitFile)
    assert [p.value for p in written.parameters] == list(fit.estimate.beta)
    assert [p.sigma for p in written.parameters] == list(fit.estimate.sigma)
    assert [p.low for p in written.parameters] == list(fit.intervals.low)
    assert [p.high for p in written.parameters] == list(fit.intervals.high)
    assert written.covariance.names == [p.name for p in written.parameters]
    np.testing.assert_array_equal(written.covariance.values, fit.intervals.covariance)
    np.testing.assert_allclose(np.sqrt(np.diag(written.covariance.values)), fit.intervals.sigma, rtol=1e-12)
    stored = read_fit(fits["iv"])
    assert [p.half for p in stored.parameters] == pytest.approx(list(fit.intervals.half), rel=1e-9)
    for joint, error in zip(stored.joints, written.joints, strict=True):
        assert {key: getattr(error, key) for key in joint.__struct_fields__} == msgspec.structs.asdict(joint)
    for name in stored.__struct_fields__:
        if name not in ("parameters", "joints"):
            assert getattr(stored, name) == getattr(written, name), name
    assert [(p.name, p.value, p.unit) for p in stored.parameters] == [
        (p.name, p.value, p.unit) for p in written.parameters
    ]


def test_the_schema_of_a_fit_is_that_of_its_file(fits):
    schema = fit_schema()
    fields = schema["$defs"]["FitFile"]
    for method, path in fits.items():
        content = json.loads(path.read_text())
        assert set(fields["required"]) <= set(content) <= set(fields["properties"]), method
    assert fields["properties"]["status"]["enum"] == [
        "converged", "diverged", "max_iterations", "not_confirmed", "solved"
    ]  # fmt: skip
    json.dumps(schema)


def test_every_file_has_a_format_and_the_report_that_is_printed(fits, tmp_path, capsys):
    robot, out = REPLAY / "scara" / "robot.toml", tmp_path / "out.json"
    study = ["study", robot, "--runs", "1", "--duration-s", "2", "--cutoffs", "5"]
    for kind, command in (
        (FitFile, ["fit", SCARA, "--all", "--method", "wls"]),
        (ValidationFile, ["validate", fits["iv"], SCARA]),
        (ComparisonFile, ["compare", fits["iv"], fits["wls"]]),
        (BaseFile, ["base", robot]),
        (StudyFile, study),
    ):
        capsys.readouterr()
        assert main([str(word) for word in [*command, "--json", out]]) == 0
        printed = capsys.readouterr().out
        content = msgspec.json.decode(out.read_bytes(), type=kind)
        assert content.format == FORMAT
        assert printed.startswith(content.report.title)
        for section in content.report.sections:
            assert section.title in printed
            assert all(line in printed for line in section.lines)
            assert all(isinstance(row[0], str) and row[0] in printed for row in section.rows)


def test_known_values_are_a_file_of_their_own(tmp_path):
    from identification.report import base_file
    from identification.study import study_truth

    robot = signals_of(SCARA).robot
    base, true = study_truth(robot)
    write_json(tmp_path / "truth.json", base_file(base, robot, true))
    earlier = json.loads((REPLAY / "scara" / "truth.json").read_text())
    now = json.loads((tmp_path / "truth.json").read_text())
    assert keys(earlier) - {".parameters[].sigma_hac"} <= keys(now)  # the interval is in its place
    assert now["parameters"] == earlier["parameters"]
    assert now["format"] == FORMAT
    assert read_fit(tmp_path / "truth.json").beta(base, "truth.json").tolist() == list(true)


def test_a_comparison_holds_the_differences(fits, tmp_path):
    out = tmp_path / "both.json"
    assert main(["compare", str(fits["iv"]), str(fits["wls"]), "--json", str(out)]) == 0
    content = json.loads(out.read_text())
    a, b = (json.loads(fits[name].read_text())["parameters"] for name in ("iv", "wls"))
    assert (content["a"], content["b"]) == ("iv", "wls")
    for d, x, y in zip(content["differences"], a, b, strict=True):
        assert (d["name"], d["a"]["value"], d["b"]["value"]) == (x["name"], x["value"], y["value"])
        assert d["off"] == x["value"] - y["value"]
