"""What the terminal shows: every digit at any width, names as they are, and what the
words under a table say.
"""

import json
import re

import pytest
from conftest import REPLAY, ROOT
from fits_of_records import signals_of

from identification.commands import main
from identification.regression import Overrides
from identification.report import Document, Section, Table, columns, print_whole
from identification.results import fit_document, fit_file, identify

SESSION = REPLAY / "scara" / "session.mcap"


@pytest.fixture
def narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich then takes the captured output for a terminal
    monkeypatch.setenv("LINES", "50")


def test_narrow_terminal_keeps_all_digits(narrow, capsys, tmp_path):
    out = tmp_path / "fit.json"
    assert main(["fit", str(SESSION), "--method", "iv", "--all", "--json", str(out)]) == 0
    told = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert "…" not in told
    for p in json.loads(out.read_text())["parameters"]:
        # not a folded line that begins with the name
        (row,) = re.findall(rf"(?m)^{p['name']} .*-?[0-9]+\.[0-9]+ +[0-9.]+ .*", told)
        value, half = (float(x) for x in re.findall(r"-?\d+\.\d+", row)[:2])
        assert value == pytest.approx(p["value"], abs=0.01 * p["sigma"])
        assert half == pytest.approx((p["high"] - p["low"]) / 2, rel=0.01)
    assert max(len(line) for line in told.splitlines()) < 90


def test_readme_shows_printed_real_record(emps, capsys):
    print_whole(fit_document(fit_file(identify(signals_of(emps), Overrides()))), short=True)
    printed = [re.findall(r"[^\s│┃]+", line) for line in capsys.readouterr().out.splitlines()]
    page = (ROOT / "identification" / "docs" / "reading-a-fit.md").read_text()
    (shown,) = re.findall(r"^    EMPS: .*\n(?:    .*\n)+", page, flags=re.MULTILINE)
    shown = [line.split() for line in shown.splitlines()]
    assert len(shown) >= 4
    for *line, last in shown:
        if last == "...":
            assert line in [whole[: len(line)] for whole in printed]
        else:
            assert [*line, last] in printed


@pytest.mark.parametrize("name", ["run[/b].mcap", "run:smile:.mcap"])
def test_names_printed_verbatim(name, capsys, tmp_path):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    assert (
        main(
            ["simulate", str(REPLAY / "scara" / "robot.toml"), "-o", str(path), "--duration-s", "3"]
        )
        == 0
    )
    assert f"{path}: simulated" in capsys.readouterr().out
    assert main(["validate", str(REPLAY / "scara" / "fit.json"), str(path)]) == 0
    out = capsys.readouterr().out
    assert f"{path.name}: 1000 Hz" in out
    assert "evaluated on: " in out, "nothing is fitted"
    assert "fitted: " not in out
    section = Section(
        title=name,
        table=Table(columns=columns(name), rows=((name,),)),
        lines=(name,),
        warnings=(name,),
    )
    print_whole(Document(title=f"{name}: fit", sections=(section,)))
    assert capsys.readouterr().out.count(name) == 6
