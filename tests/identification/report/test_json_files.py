"""JSON files: every key of earlier versions is there, each file has the version of its format."""

import json
import re

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from fits_of_records import iv_of, ls_of

from identification.commands import main
from identification.report import FitFile, ValidationFile, read_fit, write_json
from identification.report.fit_file import NEW_WORDS
from identification.results import fit_file

SCARA = REPLAY / "scara" / "session.mcap"


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    folder, files = tmp_path_factory.mktemp("fits"), {}
    for method, fit in (("iv", iv_of(SCARA)), ("wls", ls_of(SCARA))):
        files[method] = folder / f"{method}.json"
        write_json(files[method], fit_file(fit))
    return files


def keys(value, place="") -> set[str]:
    if isinstance(value, dict):
        return {
            p for key, x in value.items() for p in (f"{place}.{key}", *keys(x, f"{place}.{key}"))
        }
    return {p for x in value for p in keys(x, f"{place}[]")} if isinstance(value, list) else set()


def lasting_keys(earlier) -> set[str]:
    """Those of a file of an earlier version but its report, which is printed, a replaced
    deviation, and a test that went.
    """
    went = (".report", ".parameters[].sigma_hac", ".instrument_tests.dwh_")
    return {key for key in keys(earlier) if not key.startswith(went)}


def test_fit_keeps_keys_of_earlier_versions(fits):
    earlier = json.loads((REPLAY / "scara" / "fit.json").read_text())
    now = json.loads(fits["iv"].read_text())
    assert earlier["method"] == now["method"] == "iv"
    assert lasting_keys(earlier) <= keys(now)
    without = json.loads(fits["wls"].read_text())
    only_iv = {
        "reason",
        "pass_returned",
        "start",
        "reference",
        "controller",
        "iterations",
        "instrument_tests",
    }
    only_iv |= {"contrast_half_widths", "rows_used_percent", "saturated_percent", "direct_model"}
    only_iv.add("least_squares")
    assert set(now) - set(without) == only_iv


def test_words_of_earlier_versions_are_read(fits, tmp_path, capsys):
    """Of tests, levels and assumptions, in every command that reads a fit."""
    text, path = fits["iv"].read_text(), tmp_path / "fit.json"
    for old, new in NEW_WORDS.items():
        text = re.sub(f'("(?:test|level|what)": )"{new}"', rf'\1"{old}"', text)
    path.write_text(text)
    assert '"test": "halves"' in text
    assert '"test": "convergence"' not in text
    assert read_fit(path) == read_fit(fits["iv"])
    for command in ("validate {} {}", "compare {} {}", "view {} -o {}.html"):
        other = {"validate": SCARA, "compare": fits["iv"], "view": path}[command.split()[0]]
        assert main(command.format(path, other).split()) == 0
    assert "convergence" in (tmp_path / "fit.json.html").read_text()
    capsys.readouterr()


def test_fit_round_trips_through_json(fits):
    fit = iv_of(SCARA)
    written, made = read_fit(fits["iv"]), fit_file(fit)
    columns = {
        "value": fit.beta,
        "sigma": fit.estimate.sigma,
        "low": fit.intervals.low,
        "high": fit.intervals.high,
    }
    for key, expected in columns.items():
        assert [getattr(p, key) for p in written.parameters] == list(expected)
    assert written.covariance.names == [p.name for p in written.parameters]
    np.testing.assert_array_equal(written.covariance.values, fit.intervals.covariance)
    np.testing.assert_allclose(
        np.sqrt(np.diag(written.covariance.values)), fit.intervals.sigma, rtol=1e-12
    )
    assert [p.half for p in written.parameters] == pytest.approx(list(fit.intervals.half), rel=1e-9)
    for name in made.__struct_fields__:
        # numbers of these may be null
        if name not in ("essential", "instrument_tests", "trust", "iterations"):
            assert getattr(made, name) == getattr(written, name), name


def test_every_file_has_format_and_keys(fits, tmp_path):
    robot, out = REPLAY / "scara" / "robot.toml", tmp_path / "out.json"
    study = ["study", robot, "--runs", "1", "--duration-s", "2"]
    for kind, expected, command in (
        (FitFile, set(), ["fit", SCARA, "--all", "--method", "wls"]),
        (ValidationFile, set(), ["validate", fits["iv"], SCARA]),
        (dict, {"a", "b", "differences"}, ["compare", fits["iv"], fits["wls"]]),
        (dict, {"robot", "joint_names", "parameters"}, ["base", robot]),
        (dict, {"study", "parameters", "true", "summaries", "runs"}, study),
    ):
        assert main([str(word) for word in [*command, "--json", out]]) == 0
        msgspec.json.decode(out.read_bytes(), type=kind)
        content = json.loads(out.read_text())
        assert content["format"] == 1
        assert not expected or set(content) == {"format", *expected}
        assert "report" not in content
        if "differences" in content:
            assert (content["a"], content["b"]) == ("iv", "wls")
            for d, x, y in zip(
                content["differences"], iv_of(SCARA).beta, ls_of(SCARA).beta, strict=True
            ):
                assert (d["a"]["value"], d["b"]["value"], d["off"]) == (x, y, x - y)
