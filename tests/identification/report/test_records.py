"""Tables of records in Python: found by position and name, shown as text and HTML, as columns."""

import html
import pickle
import re
import sys
from types import SimpleNamespace

import pytest
from conftest import REPLAY

import identification
from identification.report import Records

FIT = identification.load(REPLAY / "tx40" / "fit.json")
TRUE = identification.load(REPLAY / "tx40" / "truth.json")
TABLES = {
    "parameters": FIT.parameters,
    "trust": FIT.trust,
    "assumed": FIT.assumed,
    "errors": FIT.errors,
    "compare": FIT.compare(TRUE),
}


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_records_are_found_by_position_and_name(table):
    column, names = next(iter(table.to_dict().items()))
    assert table[0] is next(iter(table))
    assert table[-1] is table[len(table) - 1] is table[names[-1]]
    assert [getattr(table[name], column) for name in names] == names
    assert names[0] in table
    assert table[0] in table
    assert "nothing" not in table
    part = table[1:3]
    assert (type(part), list(part)) == (Records, [table[1], table[2]])
    assert pickle.loads(pickle.dumps(part)).to_dict() == part.to_dict()
    assert table == tuple(table)


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_text_and_html_show_same_cells(table, monkeypatch):
    monkeypatch.setenv("COLUMNS", "500")
    title, heads, _, *lines = str(table).splitlines()
    assert repr(table) == str(table)
    shown = [name for name, form in table.columns.items() if form is not None]
    assert (title, heads.split()) == (table.title, shown)
    cells = [
        [html.unescape(cell) for cell in re.findall(r"<td[^>]*>([^<]*)<", row)]
        for row in table._repr_html_().split("<tr>")[2:]
    ]
    assert [" ".join(line.split()) for line in lines] == [
        " ".join(" ".join(row).split()) for row in cells
    ]
    assert len(cells) == len(table)


def test_columns_are_attributes():
    columns, row = TABLES["compare"].to_dict(), TABLES["compare"]["Fv1"]
    k = columns["name"].index("Fv1")
    assert (columns["a.value"][k], columns["b.half_width"][k]) == (row.a.value, row.b.half_width)
    missing = Records([SimpleNamespace(name="x", a=None)], "t", {"name": "", "a.value": ".1f"})
    assert missing.to_dict() == {"name": ["x"], "a.value": [None]}
    assert str(missing).splitlines()[-1].split() == ["x", "-"]
    assert TABLES["errors"].to_dict()["unit"][-1] is None  # of a file of an earlier version


def test_values_have_decimals_of_their_interval():
    lines = {line.split()[0]: line for line in str(FIT.parameters).splitlines() if line}
    assert "viscous friction of joint_1" in lines["Fv1"]
    assert lines["Fv1"].split()[-6:-3] == ["7.93905", "0.01188", "N"]
    assert lines["Fv1"].split()[-1] == "yes"
    assert repr(FIT["Fv1"]) == (
        "Parameter(Fv1 = 7.939 ± 0.012 N m s/rad, viscous friction of joint_1)"
    )
    assert FIT["Fv1"].half == FIT["Fv1"].half_width == (FIT["Fv1"].high - FIT["Fv1"].low) / 2
    assert TRUE["Fv1"].meaning == "viscous friction of joint 1", "without names of joints"


@pytest.mark.parametrize(
    ("name", "expected"), [("fv1", {"Fv1"}), ("Fv", {"Fv1", "Fv6"}), ("?", {"ZZ1R", "Fv1", "XY2"})]
)
def test_unknown_name_gets_similar_ones(name, expected):
    with pytest.raises(identification.BadInputError) as caught:
        FIT[name]
    assert (caught.value.key, caught.value.value) == ("name", name)
    assert expected <= {*caught.value.expected.split(", ")}
    assert "\n" not in str(caught.value)


def test_notebook_does_not_take_over_texts(monkeypatch, capsys):
    """In a notebook rich shows its output itself, whatever the file."""
    text = str(FIT.assumed)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert str(FIT.assumed) == text
    assert capsys.readouterr().out == ""


def test_dataframe_needs_pandas(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(identification.BadInputError, match=r"`pip install pandas`.*\.$"):
        FIT.parameters.to_dataframe()
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda x: [*x]))
    assert FIT.parameters.to_dataframe() == [*FIT.parameters.to_dict()]


def test_dataframe_has_columns():
    pytest.importorskip("pandas")
    frame = FIT.parameters.to_dataframe().set_index("name")
    assert frame.loc["Fv1", "value"] == FIT["Fv1"].value
    assert frame.loc["Fv1", "essential"]
