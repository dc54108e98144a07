"""The report of a stored fit: what it says is that of the fit in memory, with curves on a log."""

import json
import re

import pytest
from command_runs import refused, run
from conftest import REPLAY
from fits_of_records import iv_of, picture_of

from identification.report import write_json
from identification.results import fit_file
from identification.view import write_html

SCARA = REPLAY / "scara" / "session.mcap"


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    path = tmp_path_factory.mktemp("stored") / "fit.json"
    write_json(path, fit_file(iv_of(SCARA)))
    return path


def titles(page):
    return re.findall(r"<figcaption[^>]*>([^<]+)<", page)


def test_stored_fit_report_matches_memory(stored, tmp_path, capsys):
    whole, bare, made = (tmp_path / f"{name}.html" for name in ("whole", "bare", "made"))
    write_html(made, picture_of(iv_of(SCARA)))
    assert run(capsys, "view", stored, "--log", SCARA, "-o", whole)[0] == 0
    assert run(capsys, "view", stored, "-o", bare)[0] == 0
    expected, of_log, alone = (path.read_text() for path in (made, whole, bare))

    def tables(page):
        return re.findall(r"<t[dh][^>]*>[^<]*", page), re.findall(r"<p>[^<]*", page)

    assert tables(of_log) == tables(expected) == tables(alone)
    assert set(titles(alone)) < set(titles(of_log)) == set(titles(expected))


def test_stored_fit_without_log_has_no_rerun(stored, tmp_path, capsys):
    assert "--log LOG.mcap" in refused(capsys, "view", stored, "-o", tmp_path / "fit.rrd")
    assert "requires FIT.json" in refused(capsys, "view", SCARA, "--log", stored)
    assert "requires a recording" in refused(capsys, "view", stored, "--cutoff-hz", "20")


def test_known_values_have_no_report(stored, tmp_path, capsys):
    known = tmp_path / "known.json"
    known.write_text(
        json.dumps({"format": 1, "parameters": json.loads(stored.read_text())["parameters"]})
    )
    assert "no fit of a recording" in refused(capsys, "view", known)
