"""The words of tests: each figure that a case needs is given where the case is judged."""

import ast
from importlib import import_module
from string import Formatter

import pytest
from conftest import ROOT

from identification.trust import WORDS
from identification.trust.evidence import Words
from identification.trust.verdict import FILES

PATHS = [
    *(ROOT / "identification" / "trust").glob("*.py"),
    *(ROOT / "identification" / "methods").glob("*.py"),
]
ROWS = {key: row for file in FILES for key, row in vars(file).items() if isinstance(row, Words)}
MADE_BEFORE = {"convergence", "control law", "noise bias", "cross-validation"}
NAMED = {**ROWS, **{f"WORDS[{test!r}]": row for test, row in WORDS.items()}}


def needed(text, parts):
    """Names of the figures of a template and of its parts."""
    names = {name for _, name, _, _ in Formatter().parse(text) if name}
    return {x for name in names for x in (needed(parts[name], parts) if name in parts else [name])}


def told():
    """By call of `judge` or `part` of a row: test, cases or part, and the figures given."""
    for path in PATHS:
        tree = ast.parse(path.read_text())
        dicts = {
            target.id: node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for call in (x for x in ast.walk(tree) if isinstance(x, ast.Call) and x.args):
            if getattr(call.func, "attr", "") not in ("judge", "part"):
                continue
            row = NAMED.get(ast.unparse(call.func.value))
            if row is None:  # such as `estimate.part`
                continue
            what = call.args[0]
            what = dicts.get(what.id) if isinstance(what, ast.Name) else what
            if what is not None and all(keyword.arg for keyword in call.keywords):
                given = {keyword.arg for keyword in call.keywords} | {"value"}
                names = [x.value for x in getattr(what, "keys", [what])]
                yield row.test, names, given


@pytest.mark.parametrize(("test", "names", "given"), [*told()])
def test_case_is_given_its_figures(test, names, given):
    row = WORDS[test]
    for name in names:
        case = row.cases.get(name)
        texts = (case.text, case.advice, case.finding) if case else (row.parts[name],)
        assert set().union(*(needed(text, row.parts) for text in texts)) <= given, name


def test_every_case_is_judged():
    used = {(test, name) for test, names, _ in told() for name in names}
    assert {(test, name) for test, row in WORDS.items() for name in row.cases} <= used


def test_table_has_rows_of_all_files():
    """Each by a name of its own."""
    files = [
        import_module(f"identification.trust.{path.stem}")
        for path in PATHS
        if "= Words(" in path.read_text()
    ]
    assert {file.__name__ for file in files} == {file.__name__ for file in FILES}
    assert [*WORDS.values()] == sorted(ROWS.values(), key=lambda row: (not row.of_data, row.place))


def test_every_row_has_its_function_and_place():
    """A test that no row has is never made; those without a function are made with the solution."""
    functions = {x for file in FILES for name, x in vars(file).items() if name.endswith("_test")}
    assert {row.by for row in WORDS.values()} == {None, *functions}
    assert {test for test, row in WORDS.items() if row.by is None} == MADE_BEFORE
    assert len({row.place for row in WORDS.values()}) == len(WORDS)
