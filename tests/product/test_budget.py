"""What the house may cost: statements, rooms, and the way of one fit through them.

The limits only fall: who needs more says what grants it, and who needs less lowers the limit.
"""

import ast
import dataclasses
import inspect
import sys
from functools import cache
from pathlib import Path
from types import FrameType

import pytest
from conftest import REPLAY, ROOT

from identification.commands import main

PACKAGES = ("acquisition", "identification")
MOST_STATEMENTS = {"acquisition": 8_217, "identification": 10_995, "tests": 23_065}
SLACK = 60  # statements that a limit may be above what is there before it has to fall
ROOMS = {"acquisition": 9, "identification": 15}
MOST_RECORDS, MOST_VISITS = 37, 269
LONGEST_CYCLE = 8  # rooms that a loop goes through again and again: counted once


def statements(source: str) -> int:
    """Number of statements without docstrings, which no formatting changes."""
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.stmt)]
    return sum(
        not (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        )
        for node in nodes
    )


def test_docstrings_do_not_count():
    source = '"""Text."""\nif x:\n    """Text."""\n    y = [1,\n 2]\n'
    assert statements(source) == 2


@pytest.mark.parametrize("tree", MOST_STATEMENTS)
def test_statements(tree):
    count = sum(statements(path.read_text()) for path in (ROOT / tree).rglob("*.py"))
    assert count <= MOST_STATEMENTS[tree]
    assert count > MOST_STATEMENTS[tree] - SLACK, "lower the limit to what is there"


def test_subpackage_counts():
    assert {
        p: sum(1 for x in (ROOT / p).iterdir() if (x / "__init__.py").exists()) for p in PACKAGES
    } == ROOMS


class Trip:
    """Counts, as a profiler, the types of records that are made, and the changes from room to
    room by calls and returns.
    """

    def __init__(self) -> None:
        self.records: set[type] = set()
        self.visits: list[str] = []
        self._inside: list[str] = []

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_name == "__init__" and code.co_filename == "<string>":
            made = type(frame.f_locals["self"])
            if dataclasses.is_dataclass(made) and made.__module__.startswith("identification."):
                self.records.add(made)
        room = room_of(code.co_filename)
        if event not in ("call", "return") or not room or not code.co_flags & inspect.CO_OPTIMIZED:
            return
        if event == "call":
            self._inside.append(room)
        elif self._inside:
            self._inside.pop()
        if self._inside and self.visits[-1:] != self._inside[-1:]:
            self.visits.append(self._inside[-1])
            while n := repeated(self.visits):
                del self.visits[-n:]


@cache
def room_of(file: str) -> str:
    """The room, or the file beside the rooms, that code of the packages stands
    in; empty for other code.
    """
    path = Path(file)
    parts = path.relative_to(ROOT).parts if path.is_relative_to(ROOT) else ("",)
    return "/".join(parts[:2]) if parts[0] in PACKAGES else ""


def repeated(visits: list[str]) -> int:
    """Length of the cycle that the visits end with twice, 0 for none."""
    lengths = (
        n
        for n in range(1, LONGEST_CYCLE + 1)
        if len(visits) >= 2 * n and visits[-n:] == visits[-2 * n : -n]
    )
    return next(lengths, 0)


def test_fit_visits_few_subpackages():
    trip, command = (
        Trip(),
        ["fit", str(REPLAY / "scara" / "session.mcap"), "--method", "iv", "--workers", "1"],
    )
    assert main(command) == 0  # imports and caches are those of any fit, whatever ran before
    sys.setprofile(trip)
    try:
        assert main(command) == 0
    finally:
        sys.setprofile(None)
    rooms = [made.__module__.split(".")[1] for made in trip.records]
    assert (
        len([room for room in rooms if room not in ("report", "view", "commands")]) <= MOST_RECORDS
    )
    assert len(trip.visits) <= MOST_VISITS, len(trip.visits)
