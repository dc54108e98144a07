"""Object dictionaries in files, EDS and DCF (CiA 306), read with canopen."""

import configparser
import io
import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

from ..errors import Location
from .objects import INTEGERS
from .transfers import Key

IDENTITY = 0x1018
MAX_DICTIONARY_BYTES = 4 * 2**20
Lines: TypeAlias = dict[str, str]  # values by keys in lower case
# These lines are neither a section nor `key = value`, and the parser would refuse them.
_OTHER = re.compile(r"(?m)^(?!\[[^;\]\n]+\]|[^\[=;#\n][^=;#\n]*=).*$")
_ENTRY = re.compile(r"([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?")
_COUNT = re.compile(r"0[xX][0-9a-fA-F]{1,2}|[1-9][0-9]{0,2}")
# Leading zeros are removed from single digits. Larger numbers are not read, since they may be
# octal.
_ZEROS = re.compile(r"(?m)(?<==)[ \t]*0+(?=[0-9][ \t]*(?:;|$))")


@dataclass(frozen=True, kw_only=True)
class DictionaryEntry:
    """An entry of an object dictionary.

    Attributes:
        type: I8 to U32; empty if a PDO cannot carry it.
        writable: True if the object can be written.
        value: value of the DCF, or the default; None if there is none.
        problem: what cannot be read of the entry, and where; else empty.
    """

    type: str = ""
    writable: bool = False
    value: int | None = None
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class ObjectDictionary:
    """An object dictionary from a file.

    Attributes:
        entries: entries by index and sub-index.
        vendor: vendor number in [DeviceInfo]; 0 if it is not given.
        product: product number in [DeviceInfo]; 0 if it is not given.
        warnings: parts that are not read.
    """

    entries: Mapping[Key, DictionaryEntry]
    vendor: int
    product: int
    warnings: tuple[str, ...] = ()

    @property
    def identity(self) -> list[tuple[int, str, int]]:
        """Sub-index, name and number of vendor and product, if 1018h or [DeviceInfo] gives them."""
        return [
            (sub, name, number)
            for sub, name, stated in ((1, "vendor", self.vendor), (2, "product", self.product))
            if (IDENTITY, sub) in self.entries
            and (number := self.entries[IDENTITY, sub].value or stated)
        ]


@lru_cache(maxsize=32)
def load_dictionary(data: bytes, place: str, node: int) -> ObjectDictionary:
    """Read types, access and values of an object dictionary (EDS or DCF, CiA 306).

    An entry that cannot be read is not an error. Its `problem` is reported if the entry is needed.

    Parameters
    ----------
    data : content of the file.
    place : name of the file in errors.
    node : node id, which replaces `$NODEID`.

    Raises
    ------
    BadInputError : the file is too large, contains no objects, or contains a section or key twice.
    """
    Location(place).require(
        len(data) <= MAX_DICTIONARY_BYTES,
        text=f"the file has {len(data)} bytes",
        expected=f"at most {MAX_DICTIONARY_BYTES}",
    )
    # Only names may have other encodings, since numbers are the same in all of them.
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    file = _File(data.decode(encoding, errors="replace"), place, node)
    entries = {key: file.entry(lines, *value) for key, lines, *value in file.contents()}
    Location(place).require(
        entries, text="the file contains no objects", advice="Choose an EDS or DCF"
    )
    about = file.sections.get("DEVICEINFO", {}) | {"datatype": "7"}
    vendor, product = (
        file.entry(about, "DEVICEINFO", key) for key in ("vendornumber", "productnumber")
    )
    return ObjectDictionary(
        entries=entries,
        vendor=vendor.value or 0,
        product=product.value or 0,
        warnings=tuple(
            f"{number.problem}: it is read as 0, and not checked"
            for number in (vendor, product)
            if number.problem
        ),
    )


class _File:
    """The sections of a file by their names in capitals, and its entries as canopen reads them.

    Some parts that canopen refuses or misreads are changed before: lines without meaning, numbers
    with leading zeros, and compact storage.
    """

    def __init__(self, text: str, place: str, node: int) -> None:
        # canopen warns about readable files, and would print that between the output of a command.
        logging.getLogger("canopen").addHandler(logging.NullHandler())
        self._place, self._node = place, node
        # The first lines may not belong to a section, so one is added.
        text = "\n".join(("[-]", *(line.strip() for line in io.StringIO(text, None))))
        self._text = re.sub(
            r"(?m)^\[.*",
            lambda found: found[0].upper().replace("SUB", "sub"),
            _ZEROS.sub("", _OTHER.sub("", text)),
        )
        self._parser = configparser.RawConfigParser(
            delimiters=("=",), inline_comment_prefixes=(";",), default_section=""
        )
        try:
            self._parser.read_string(self._text)
        except (configparser.DuplicateOptionError, configparser.DuplicateSectionError) as error:
            key = f"contains {error.option!r}" if hasattr(error, "option") else "exists"
            Location(f"{place}: line {(error.lineno or 1) - 1}").refuse(
                text=f"[{error.section}] {key} twice", advice="Remove one"
            )
        self.sections = {name: dict(self._parser[name]) for name in self._parser.sections()}

    def contents(self) -> Iterator[tuple[Key, Lines, str, str]]:
        """Yield the lines that describe each entry, and the section and key of its value.

        Sub-indices come after their object. Compact storage (CiA 306: CompactSubObj) is expanded:
        all sub-indices have the lines of their object, and the values of a section such as
        [1A00Value].
        """
        for name in sorted(filter(_ENTRY.fullmatch, self.sections)):
            lines, index, sub = self.sections[name], int(name[:4], 16), int(name[7:] or "0", 16)
            compact = lines.get("compactsubobj", "") if name[4:] == "" else ""
            if compact.strip("0xX"):
                yield (index, 0), lines | {"datatype": "5"}, name, "compactsubobj"
                values = self.sections.get(f"{name}VALUE", {})
                for k in range(1, 1 + int(compact, 0) if _COUNT.fullmatch(compact) else 1):
                    own = (f"{name}VALUE", str(k)) if str(k) in values else (name, "defaultvalue")
                    yield (index, k), values | lines, *own
            else:
                key = "parametervalue" if lines.get("parametervalue") else "defaultvalue"
                yield (index, sub), lines, name, key

    def entry(self, lines: Lines, section: str, key: str) -> DictionaryEntry:
        """Return the entry that `lines` describe, with the value of a key in a section."""
        from canopen.objectdictionary import eds

        # canopen requires the first two keys. It would refuse some values of the last one, which is
        # not used.
        given = {"parametername": "", "accesstype": "", **lines, "pdomapping": "0"}
        self._parser["-"] = given | {"defaultvalue": lines.get(key, "")}
        try:
            found = eds.build_variable(self._parser, "-", self._node, 0)
        except (configparser.Error, ValueError):
            return DictionaryEntry(problem=self._problem(lines, section, "datatype"))
        type_ = INTEGERS.get(found.data_type, "")
        # Python accepts underscores in numbers, but CiA 306 does not.
        known = type_ and isinstance(found.default, int) and "_" not in lines[key]
        return DictionaryEntry(
            type=type_,
            writable="w" in found.access_type,
            value=found.default if known else None,
            problem="" if known or not type_ else self._problem(lines, section, key),
        )

    def _problem(self, lines: Lines, section: str, key: str) -> str:
        """Return the line of a key whose value is not a number; empty if the key is missing."""
        found = key in lines and re.search(rf"(?ims)^\[{section}\].*?^({key})[ \t]*=", self._text)
        if not found:
            return ""
        problem = f"= {lines[key]!r} is not a number" if lines[key] else "is empty"
        line = self._text.count("\n", 0, found.start(1))
        return f"{self._place}: line {line}: {found[1]} {problem}"
