"""What a command prints into a pipe without `--all`: at most a screen; names,
paths and errors are whole.
"""

from dataclasses import replace

import msgspec
import pytest
from conftest import REPLAY

from identification.report import (
    Document,
    ParameterSet,
    Section,
    Table,
    columns,
    comparison_document,
    print_whole,
    read_fit,
)

MAX_WIDTH = 120
LONG, MANY = "x" * 150, "12 % " * 40
WIDE = Document(
    title="a title of words " * 12,
    sections=(
        Section(
            lines=("word " * 60, f"/a/{LONG}/log.mcap in a sentence of some words"),
            warnings=tuple(f"{'a' * k} {MANY}" for k in range(5)),
        ),
        Section(
            title="hidden",
            lines=("only with --all",),
            short=Section(hint="all 3 lines"),
        ),
        Section(table=Table(columns=columns("name"), rows=((LONG,),))),
        Section(  # its heads are folded at hyphens, too
            table=Table(columns=columns(numbers=("95 % half-width",) * 9), rows=(("1.234",) * 9,))
        ),
    ),
)


@pytest.mark.parametrize(
    ("given", "most"),
    [("", MAX_WIDTH), ("wide", MAX_WIDTH), ("0", MAX_WIDTH), ("-5", MAX_WIDTH), ("80", 80)],
)
def test_short_report_wraps_without_cutting_names(given, most, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", given)
    print_whole(WIDE, f"open the plots: rerun /a b/{LONG} {LONG}", short=True)
    out = capsys.readouterr().out
    lines = out.splitlines()
    assert out.count(LONG) == 4
    assert max(len(line.strip()) for line in lines if LONG not in line and "─" not in line) <= most
    assert f"open the plots: rerun /a b/{LONG} {LONG}" in lines, "a command is one line"
    assert out.count("word") == 60 + 12 + 1
    assert not any(line.strip().startswith("%") for line in lines), (
        "a number and its unit stay together"
    )
    assert "only with --all" not in out
    assert "(show all 3 lines with --all)" in lines
    assert not set("┃│") & set(out)


def test_all_option_hides_nothing(capsys):
    print_whole(WIDE)
    lines = capsys.readouterr().out.splitlines()
    assert {("word " * 60).strip(), "only with --all"} <= set(lines)
    assert "(show all 3 lines with --all)" not in lines


def test_short_table_counts_hidden_rows():
    rows = tuple((f"p{k}",) for k in range(21))
    section = Section(
        table=Table(columns=columns("name"), rows=rows), lines=("a line",), warnings=("a warning",)
    )
    short = section.with_short_table([5, 2]).short
    assert short.table.rows == (("p2",), ("p5",))
    assert (short.lines, short.hint) == (("a line",), "all 21 rows")
    assert short.warnings == ("a warning",)
    few = Section(table=Table(columns=columns("name"), rows=rows[:20]))
    assert few.with_short_table([1]) is few


def test_short_comparison_has_largest_and_warnings():
    a, b = (ParameterSet.of_file(read_fit(REPLAY / "tx40" / "fit.json"), label) for label in "ab")
    moved = dict(b.parameters)
    for name in ("Fv1", "Ia6"):
        moved[name] = msgspec.structs.replace(
            moved[name], value=moved[name].value + 5 * moved[name].sigma
        )
    document = comparison_document(a, replace(b, parameters=moved), ("a warning",)).short
    (section,) = document.sections
    assert (document.title, section.title) == ("a and b", ""), "its title once"
    assert section.warnings == ("a warning",)
    assert len(section.table.rows) == 10
    assert {"Fv1", "Ia6"} <= {row[0] for row in section.table.rows}
    assert section.hint == "all 60 rows"
