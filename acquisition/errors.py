"""Errors: their data, and the one-line message."""

import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Final, NoReturn, TypeVar

T = TypeVar("T")
_NO_VALUE: Final = object()
_MAX_VALUE_LENGTH = 80  # files may contain anything
_KEYWORDS = {
    "range": "position",
    "period": "period_s",
    "workers": "Work(N)",
    "allow-untrusted": "allow_untrusted=True",
}


def one_line(text: str) -> str:
    """`text` without line breaks and control characters, which quoted file names
    and contents may have.
    """
    return "".join(
        c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(text.split())
    )


def listed(names: Sequence[str]) -> str:
    """The expected names for an error; of many, the first 30."""
    shown = ", ".join(names[:30])
    return shown + (f" and {len(names) - 30} more" if len(names) > 30 else "") or "(nothing)"


def holding(texts: Mapping[str, object]) -> list[str]:
    """The texts whose condition holds."""
    return [text for text, holds in texts.items() if holds]


class HeldBack(AbstractContextManager["HeldBack"]):
    """Hold back whatever is raised inside its blocks, so that the next step of a stop is taken.

    Attributes:
        interrupt: the first KeyboardInterrupt or SystemExit, to be raised after the stop.
        problem: the first other error but `RobotIdimError`, in words; empty without one.
    """

    def __init__(self) -> None:
        self.interrupt: BaseException | None = None
        self.problem = ""

    def __exit__(self, _: object, error: BaseException | None, __: object) -> bool:
        if not isinstance(error, Exception):
            self.interrupt = self.interrupt or error
        elif not isinstance(error, RobotIdimError):
            self.problem = self.problem or f"{type(error).__name__}: {error}"
        return True

    def raise_interrupt(self) -> None:
        """Raise `interrupt` if there is one."""
        if self.interrupt is not None:
            raise self.interrupt


class RobotIdimError(Exception):
    """Whatever ends a command or a call of both packages in one line::

        RobotIdimError
          BadInputError    a file, a key, an option or an argument is not what it has to be
          NoFitError       the recordings do not determine an estimate
          RefusedError     not done because it is not safe: `what`, `why`
          BusFaultError    the bus, a drive or the recorder failed
            NoAnswerError    a `node` did not answer in time
            SdoAbortedError  a `node` refused an access to an `index`, with the abort `code` of
                             CiA 301

    The message is `place: key = value: text: expected ...`, without the parts not given.

    Attributes:
        place: the file, the node, or a position in it.
        key: the wrong key, such as `joint[0].name`.
        value: the value found at `key`; None if it is missing or not given.
        expected: what to write instead.

    Texts not given are empty. `shown` replaces the `repr` of the value in the message, such as a
    hexadecimal number. As a string it has keyword arguments in place of options, but for commands
    in backticks; `args[0]` is for the command line.
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
        super().__init__(one_line(": ".join(filter(None, parts))))

    def __str__(self) -> str:
        return re.sub(
            "`[^`]*`?|--([a-z][a-z-]*)",
            lambda x: _KEYWORDS.get(x[1], x[1].replace("-", "_")) if x[1] else x[0],
            self.args[0],
        )


class BadInputError(RobotIdimError):
    """A file, a key, an option or an argument is not what it has to be."""


class NoFitError(RobotIdimError):
    """The recordings do not determine an estimate, or no reference determines
    one within the limits.
    """


class RefusedError(RobotIdimError):
    """What is not done because it is not safe: `what` (`motion`, `sending`), and `why`."""

    def __init__(self, why: str, *, what: str, **data: Any) -> None:
        super().__init__(why, **data)
        self.what, self.why = what, why


class BusFaultError(RobotIdimError):
    """The bus, a drive or the recorder failed."""


class NoAnswerError(BusFaultError):
    """A `node` did not answer a request in time, or not what was asked."""

    def __init__(self, text: str, *, node: int, **data: Any) -> None:
        super().__init__(text, **data)
        self.node = node


class SdoAbortedError(BusFaultError):
    """A `node` refused an access to an `index` with the abort `code` of CiA
    301; `meaning` in words.
    """

    def __init__(self, meaning: str, *, node: int, index: int, code: int, **data: Any) -> None:
        super().__init__(f"refused by the drive: {meaning} (0x{code:08X})", **data)
        self.node, self.index, self.code, self.meaning = node, index, code, meaning


@dataclass(frozen=True)
class Location:
    """A file, or a `table` of it, for errors about its content."""

    name: str
    table: str = ""

    def __str__(self) -> str:
        return self.name

    def at(self, table: str) -> "Location":
        """A table of this place."""
        return Location(self.name, f"{self.table}.{table}".lstrip("."))

    def refuse(
        self,
        key: str = "",
        value: Any = _NO_VALUE,
        expected: str = "",
        *,
        text: str = "",
        shown: str = "",
    ) -> NoReturn:
        """Raise a `BadInputError` for a key of this place."""
        raise BadInputError(
            text,
            place=self.name,
            key=f"{self.table}.{key}".strip("."),
            value=value,
            shown=shown,
            expected=expected,
        )

    def require(
        self,
        holds: object,
        key: str = "",
        value: Any = _NO_VALUE,
        expected: str = "",
        *,
        text: str = "",
        shown: str = "",
    ) -> None:
        """Raise as `refuse` unless a condition holds."""
        if not holds:
            self.refuse(key, value, expected, text=text, shown=shown)

    def given(
        self,
        found: T | None,
        key: str = "",
        value: Any = _NO_VALUE,
        expected: str = "",
        *,
        text: str = "",
    ) -> T:
        """Return what was found; raise as `refuse` if that is None."""
        if found is None:
            self.refuse(key, value, expected, text=text)
        return found


COMMAND_LINE: Final = Location("")  # of options and arguments, which their keys name
