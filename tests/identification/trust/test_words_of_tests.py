"""The words of tests: each figure that a case needs is given where the case is judged."""

import ast
from string import Formatter

import pytest
from conftest import ROOT

from identification.trust import WORDS

FILES = [
    *(ROOT / "identification" / "trust").glob("*.py"),
    *(ROOT / "identification" / "methods").glob("*.py"),
]
NAMES = {"LAW": "control law", "HELD_OUT": "held-out blocks", "PRIOR": "prior"}
NAMES |= {"PHYSICAL": "physical", "NOISE": "position noise"}


def needed(text, parts):
    """Names of the figures of a template and of its parts."""
    names = {name for _, name, _, _ in Formatter().parse(text) if name}
    return {x for name in names for x in (needed(parts[name], parts) if name in parts else [name])}


def told():
    """By call of `judge` or `part_of`: test, cases or part, and the figures that are given."""
    for path in FILES:
        tree = ast.parse(path.read_text())
        dicts = {
            target.id: node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for call in (x for x in ast.walk(tree) if isinstance(x, ast.Call) and len(x.args) > 1):
            if getattr(call.func, "id", "") not in ("judge", "part_of"):
                continue
            test, what = call.args[:2]
            what = dicts.get(what.id) if isinstance(what, ast.Name) else what
            if what is not None and all(keyword.arg for keyword in call.keywords):
                given = {keyword.arg for keyword in call.keywords} | {"value"}
                names = [x.value for x in getattr(what, "keys", [what])]
                yield getattr(test, "value", NAMES.get(getattr(test, "id", ""))), names, given


@pytest.mark.parametrize(("test", "names", "given"), [*told()])
def test_a_case_is_given_all_its_figures(test, names, given):
    row = WORDS[test]
    for name in names:
        case = row.cases.get(name)
        texts = (case.text, case.advice, case.finding) if case else (row.parts[name],)
        assert set().union(*(needed(text, row.parts) for text in texts)) <= given, name


def test_every_case_of_the_words_is_judged():
    used = {(test, name) for test, names, _ in told() for name in names}
    assert {(test, name) for test, row in WORDS.items() for name in row.cases} <= used
