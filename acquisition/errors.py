"""Errors: their data, and the one line made of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NoReturn

_NO_VALUE: Final = object()
_LONGEST_VALUE = 80  # characters; files from elsewhere may hold anything


def one_line(text: str) -> str:
    """`text` without line breaks and control characters, whatever file names and file contents it quotes."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(text.split()))


def listed(names: Sequence[str]) -> str:
    """Names for an error that says what was expected; of many the first 30."""
    shown = ", ".join(names[:30])
    return shown + (f" and {len(names) - 30} more" if len(names) > 30 else "") or "(nothing)"


class RobotIdimError(Exception):
    """The errors of both packages, each in one line: `place: key = value: text: expected ...`, parts not given left out.

    Attributes:
        place: the file, or where in it; empty where not given.
        key: what is wrong there, `joint[0].name`; empty where not given.
        value: the value found at `key`; None where it is missing, or not given.
        expected: what to write instead; empty where not given.

    `shown` is the value as the message has it, where that is not its `repr`: a number in hexadecimal, or with a unit.
    """

    def __init__(
        self,
        text: str = "",
        *,
        place: str = "",
        key: str = "",
        value: Any = _NO_VALUE,
        shown: str = "",
        expected: str = "",
    ) -> None:
        self.place, self.key, self.expected = place, key, expected
        self.value = None if value is _NO_VALUE else value
        if value is None:
            key = f"{key} is missing"
        elif value is not _NO_VALUE:
            key = f"{key} = {shown or repr(value)}"[: len(key) + _LONGEST_VALUE]
        parts = (place, key, text, expected and f"expected {expected}")
        super().__init__(one_line(": ".join(part for part in parts if part)))


class AcquisitionError(RobotIdimError):
    """Bad input, or a session that failed."""


@dataclass(frozen=True)
class Place:
    """A file, or a `table` of it, that is being read: refuses what stands there by key, value and what is expected."""

    name: str
    table: str = ""

    def __str__(self) -> str:
        return self.name

    def at(self, table: str) -> "Place":
        """A table of it."""
        return Place(self.name, f"{self.table}.{table}".lstrip("."))

    def refuse(
        self, key: str = "", value: Any = _NO_VALUE, expected: str = "", *, text: str = "", shown: str = ""
    ) -> NoReturn:
        """Raise the `AcquisitionError`; `text` and `shown` as there."""
        key = f"{self.table}.{key}".strip(".")
        raise AcquisitionError(text, place=self.name, key=key, value=value, shown=shown, expected=expected)
