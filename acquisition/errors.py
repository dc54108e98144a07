"""Errors: their data, and the one-line message."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NoReturn, Self

_NO_VALUE: Final = object()
_MAX_VALUE_LENGTH = 80  # files may contain anything


def one_line(text: str) -> str:
    """`text` without line breaks and control characters, which quoted file names and contents may have."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(text.split()))


def listed(names: Sequence[str]) -> str:
    """The expected names for an error; of many, the first 30."""
    shown = ", ".join(names[:30])
    return shown + (f" and {len(names) - 30} more" if len(names) > 30 else "") or "(nothing)"


class RobotIdimError(Exception):
    """The errors of both packages, in one line: `place: key = value: text: expected ...`, without the parts not given.

    Attributes:
        place: the file, or a position in it.
        key: the wrong key, such as `joint[0].name`.
        value: the value found at `key`; None if it is missing or not given.
        expected: what to write instead.

    Texts not given are empty. `shown` replaces the `repr` of the value in the message, such as a hexadecimal number.
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
            key = f"{key} = {shown or repr(value)}"[: len(key) + _MAX_VALUE_LENGTH]
        parts = (place, key, text, expected and f"expected {expected}")
        super().__init__(one_line(": ".join(part for part in parts if part)))

    @classmethod
    def of(cls, error: "RobotIdimError", more: str = "") -> Self:
        """The same error with its data, of this class; its message ends with `more`."""
        found = cls(f"{error.args[0]}{more}")
        found.__dict__.update(vars(error))
        return found


class AcquisitionError(RobotIdimError):
    """Bad input or a failed session."""


@dataclass(frozen=True)
class Place:
    """A file, or a `table` of it, for errors about its content."""

    name: str
    table: str = ""

    def __str__(self) -> str:
        return self.name

    def at(self, table: str) -> "Place":
        """A table of this place."""
        return Place(self.name, f"{self.table}.{table}".lstrip("."))

    def refuse(
        self, key: str = "", value: Any = _NO_VALUE, expected: str = "", *, text: str = "", shown: str = ""
    ) -> NoReturn:
        """Raise an `AcquisitionError` for a key of this place."""
        key = f"{self.table}.{key}".strip(".")
        raise AcquisitionError(text, place=self.name, key=key, value=value, shown=shown, expected=expected)
