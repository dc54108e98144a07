"""Errors: their data, and the one-line message."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Final, NoReturn, TypeVar

T = TypeVar("T")
_NO_VALUE: Final = object()
_MAX_VALUE_LENGTH = 80  # files may contain anything


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

    The message is `place: key = value: text: expected .... Advice (arguments).`, without the
    parts not given. Texts not given are empty.

    Attributes:
        text: what is wrong, a fact.
        place: the file, the node, or a position in it.
        key: the wrong key, such as `joint[0].name`, or argument, such as `speed`.
        value: the value found at `key`; None if it is missing or not given.
        expected: the type, set or range of the values of `key`.
        advice: what to do, an imperative.
        arguments: the arguments of Python that the advice needs. The command line names their
            options instead.

    `shown` replaces the `repr` of the value in the message, such as a hexadecimal number.
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
        advice: str = "",
        arguments: Sequence[str] = (),
    ) -> None:
        self.text, self.place, self.key, self.expected = text, place, key, expected
        self.advice, self.arguments = advice, arguments
        self.value = None if value is _NO_VALUE else value
        self._found = (
            ""
            if value is _NO_VALUE
            else " is missing"
            if value is None
            else f" = {shown or repr(value)}"[:_MAX_VALUE_LENGTH]
        )
        super().__init__(text)

    def message(self, options: Mapping[str, str] | None = None) -> str:
        """Return the message in one line; `options` gives the option of an argument by its name."""
        key = self.key if self.place else (options or {}).get(self.key, self.key)
        expected = self.expected and f"expected {self.expected}"
        what = ": ".join(filter(None, (self.place, key and key + self._found, self.text, expected)))
        names = ", ".join((options or {}).get(name, name) for name in self.arguments)
        todo = f"{self.advice} ({names})" if names else self.advice
        return one_line(f"{what}. {todo}." if todo else what)

    __str__ = message


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
        **texts: Any,
    ) -> NoReturn:
        """Raise a `BadInputError` for a key of this place, with its other arguments in `texts`."""
        raise BadInputError(
            place=self.name,
            key=f"{self.table}.{key}".strip("."),
            value=value,
            expected=expected,
            **texts,
        )

    def require(
        self,
        holds: object,
        key: str = "",
        value: Any = _NO_VALUE,
        expected: str = "",
        **texts: Any,
    ) -> None:
        """Raise as `refuse` unless a condition holds."""
        if not holds:
            self.refuse(key, value, expected, **texts)

    def given(
        self,
        found: T | None,
        key: str = "",
        value: Any = _NO_VALUE,
        expected: str = "",
        **texts: Any,
    ) -> T:
        """Return what was found; raise as `refuse` if that is None."""
        if found is None:
            self.refuse(key, value, expected, **texts)
        return found


COMMAND_LINE: Final = Location("")  # of options and arguments, which their keys name
