"""Decoding of TOML descriptions into typed, frozen structures.

Errors have place, key, value and what was expected.
"""

import math
import re
import tomllib
from collections.abc import Iterator
from typing import Annotated, Any, TypeVar

import msgspec
import msgspec.inspect

from ..errors import Location

T = TypeVar("T")

# The parser's memory grows with the square of a dotted key's length, and recordings
# may come from anyone.
MAX_TOML_BYTES = 256 * 1024
MAX_LINE_BYTES = 2000

# The words of msgspec's messages, and those of TOML that replace them.
_WORDS = {
    "Object contains unknown field": "there is an unknown key",
    "Object missing required field": "a key is missing:",
    "`float`": "a number",
    "`int`": "a whole number",
    "`str`": "a text",
    "`bool`": "true or false",
    "`array`": "a list",
    "`object`": "a table",
    " of length >= ": " of a length of at least ",
    " of length <= ": " of a length of at most ",
    " >= ": " of at least ",
    " <= ": " of at most ",
    " > ": " greater than ",
    " < ": " less than ",
}

Positive = Annotated[float, msgspec.Meta(gt=0)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64, pattern=r"\A[A-Za-z0-9_.\- ]+\Z")]


def note(description: str, **limits: Any) -> msgspec.Meta:
    """Return the description of a key, with its unit and default, and its limits.

    JSON Schemas and the reference of all keys show it.
    """
    return msgspec.Meta(description=description, **limits)


class TomlTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, dict=True):
    """A table of a description.

    Unknown keys are refused. `__post_init__` requires what the types cannot express.
    """

    def require(self, holds: object, key: str, value: object, says: str | tuple[str, str]) -> None:
        """Refuse the value of a key of this table unless a condition is true.

        Parameters
        ----------
        holds : the condition.
        key : the key; `parse_toml` adds the place of the table.
        value : the value found.
        says : what is expected, or a fact and an advice.
        """
        if not holds:
            raise InvalidValueError(
                key,
                value,
                {"expected": says}
                if isinstance(says, str)
                else dict(zip(("text", "advice"), says, strict=True)),
            )

    def require_all(self, *rules: tuple[object, str, object, str | tuple[str, str]]) -> None:
        """Require several conditions in order, each with the arguments of `require`."""
        for rule in rules:
            self.require(*rule)


class InvalidValueError(ValueError):
    """A wrong value of a key of a table, with the texts of its error.

    It is a `ValueError`, to which msgspec adds the place of the table.
    """


def parse_toml(text: bytes, kind: type[T], place: str) -> T:
    """Decode TOML into a structure.

    Parameters
    ----------
    text : content of the file, UTF-8.
    kind : the structure.
    place : name of the file in errors.

    Raises
    ------
    BadInputError : the text is not TOML, too long, or does not fit the structure.
    """
    file = Location(place)
    longest = max(map(len, text.splitlines()), default=0)
    if len(text) > MAX_TOML_BYTES or longest > MAX_LINE_BYTES:
        file.refuse(
            text=f"the file has {len(text)} bytes and a line of {longest} bytes",
            expected=f"at most {MAX_TOML_BYTES} and {MAX_LINE_BYTES}",
        )
    try:
        data = tomllib.loads(text.decode("utf-8"))
        for key, number in _not_finite(data, ""):
            file.refuse(key, number, "a finite number")
    # Wrong UTF-8 and endless digits raise ValueError.
    except (ValueError, RecursionError) as error:
        file.refuse(text=f"this is not valid TOML: {error}")
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        message, _, where = str(error).rpartition(" - at `$")
        message, path = (message, where[:-1].lstrip(".")) if message else (str(error), "")
        if isinstance(error.__cause__, InvalidValueError):
            file.at(path).refuse(*error.__cause__.args[:2], **error.__cause__.args[2])
        if message.startswith("Invalid enum value"):
            message = f"Expected one of {', '.join(map(repr, _choices(kind, path)))}"
        message = re.sub("|".join(_WORDS), lambda found: _WORDS[found[0]], message)
        expected = message.removeprefix("Expected ") if message.startswith("Expected ") else ""
        value = _value_at(data, path)
        found = {} if value is None or isinstance(value, dict | list) else {"value": value}
        file.refuse(
            path or "top level", text="" if expected else message, expected=expected, **found
        )


def _choices(kind: Any, path: str) -> tuple[Any, ...]:
    """Return the words that `kind` allows at `path`."""
    at = _without_note(msgspec.inspect.type_info(kind))
    for step in re.findall(r"\w+|\[[^]]*\]", path):
        if isinstance(at, msgspec.inspect.UnionType):
            types = (t for t in at.types if not isinstance(t, msgspec.inspect.NoneType))
            # A step into a list needs the list among the types; otherwise the first type is right.
            at = max(
                types,
                key=lambda t: step.startswith("[") and isinstance(t, msgspec.inspect.VarTupleType),
            )
        match at:
            case msgspec.inspect.VarTupleType():
                at = _without_note(at.item_type)
            case msgspec.inspect.StructType():
                at = _without_note(next(x.type for x in at.fields if x.encode_name == step))
    if isinstance(at, msgspec.inspect.UnionType):
        at = next((t for t in at.types if isinstance(t, msgspec.inspect.LiteralType)), at)
    return at.values if isinstance(at, msgspec.inspect.LiteralType) else ()


def _without_note(found: msgspec.inspect.Type) -> msgspec.inspect.Type:
    return found.type if isinstance(found, msgspec.inspect.Metadata) else found


def _value_at(data: Any, path: str) -> Any:
    for step in re.findall(r"[^][.]+", path):
        try:
            data = data[int(step) if isinstance(data, list) else step]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return data


def _not_finite(data: Any, key: str) -> Iterator[tuple[str, float]]:
    """Yield keys and values of the numbers that are not finite."""
    if isinstance(data, float) and not math.isfinite(data):
        yield key, data
    for name, value in data.items() if isinstance(data, dict) else ():
        yield from _not_finite(value, f"{key}.{name}".lstrip("."))
    for i, value in enumerate(data) if isinstance(data, list) else ():
        yield from _not_finite(value, f"{key}[{i}]")
