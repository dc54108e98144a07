"""Errors: their data, and the one-line message."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Final, NoReturn, TypeVar

T = TypeVar("T")
_NO_VALUE: Final = object()
_MAX_VALUE_LENGTH = 80  # files may contain anything


def one_line(text: str) -> str:
    """Return `text` without line breaks and control characters.

    File names and contents may have such characters.
    """
    return "".join(
        c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(text.split())
    )


def listed(names: Sequence[str]) -> str:
    """List the expected names for an error; of many names, the first 30."""
    shown = ", ".join(names[:30])
    return shown + (f" and {len(names) - 30} more" if len(names) > 30 else "") or "(nothing)"


def holding(texts: Mapping[str, object]) -> list[str]:
    """Return the texts whose condition is true."""
    return [text for text, holds in texts.items() if holds]


class HeldBack(AbstractContextManager["HeldBack"]):
    """Context manager of the steps of a stop, which holds back what a step raises.

    So the next step is taken after an exception, too.

    Attributes:
        interrupt: the first KeyboardInterrupt or SystemExit, raised after the stop.
        problem: the first other error except `RobotIdimError`, in words; empty without one.
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
    """An error of both packages, with a message of one line::

        RobotIdimError
          BadInputError    a file, a key, an option or an argument is not what it has to be
          NoFitError       the recordings do not determine an estimate
          RefusedError     an action is refused because it is not safe: `what`, `why`
          BusFaultError    the bus, a drive or the recorder failed
            NoAnswerError    a `node` did not answer in time
            SdoAbortedError  a `node` refused an access to an `index`, with the abort `code` of
                             CiA 301

    The message is `place: key = value: text: expected .... Advice (arguments).`, without the parts
    that are not given. These are empty texts.

    Attributes:
        text: what is wrong, as a fact.
        place: the file, the node, or a position in it.
        key: the wrong key, such as `joint[0].name`, or argument, such as `speed`.
        value: the value found at `key`; None if it is missing or not given.
        expected: the type, set or range of the values of `key`.
        advice: what to do, as an imperative.
        arguments: the Python arguments that the advice needs. The command line shows their options
            instead.

    The argument `shown` replaces the `repr` of the value in the message, e.g. by a hexadecimal
    number.
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
        """Return the message in one line; `options` maps arguments to options."""
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
    """The recordings do not determine an estimate, or no reference within the limits does."""


class RefusedError(RobotIdimError):
    """An action that is refused because it is not safe: `what` (`motion`, `sending`), and `why`."""

    def __init__(self, why: str, *, what: str, **data: Any) -> None:
        super().__init__(why, **data)
        self.what, self.why = what, why


class BusFaultError(RobotIdimError):
    """The bus, a drive or the recorder failed."""


class NoAnswerError(BusFaultError):
    """A `node` did not answer a request in time, or its answer did not fit."""

    def __init__(self, text: str, *, node: int, **data: Any) -> None:
        super().__init__(text, **data)
        self.node = node


class SdoAbortedError(BusFaultError):
    """Error for an access to an `index` that a `node` refused with an abort `code` of CiA 301.

    `meaning` is the code in words.
    """

    def __init__(self, meaning: str, *, node: int, index: int, code: int, **data: Any) -> None:
        super().__init__(f"the drive refused the access: {meaning} (0x{code:08X})", **data)
        self.node, self.index, self.code, self.meaning = node, index, code, meaning


@dataclass(frozen=True)
class Location:
    """A file, or a `table` in it, for errors about its content."""

    name: str
    table: str = ""

    def __str__(self) -> str:
        return self.name

    def at(self, table: str) -> "Location":
        """Return the location of a table in this one."""
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
        """Raise as `refuse` unless a condition is true."""
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
        """Return `found`; raise as `refuse` if it is None."""
        if found is None:
            self.refuse(key, value, expected, **texts)
        return found


COMMAND_LINE: Final = Location("")  # of options and arguments, which their keys name
