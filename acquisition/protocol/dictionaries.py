"""Object dictionaries in files: EDS and DCF (CiA 306), with canopen."""

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
Lines: TypeAlias = dict[str, str]  # values by keys in small letters
# Lines that are neither a section nor `key = value`.
_OTHER = re.compile(r"(?m)^(?!\[[^;\]\n]+\]|[^\[=;#\n][^=;#\n]*=).*$")
_ENTRY = re.compile(r"([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?")
_COUNT = re.compile(r"0[xX][0-9a-fA-F]{1,2}|[1-9][0-9]{0,2}")
# Octal numbers and decimal ones with leading zeros are the same up to 7: others are not read.
_ZEROS = re.compile(r"(?m)(?<==)[ \t]*0+(?=[0-9][ \t]*(?:;|$))")


@dataclass(frozen=True, kw_only=True)
class DictionaryEntry:
    """An entry: `type` is I8 to U32, or empty if no PDO can carry it; `value` is the
    DCF's value or the default; `problem` says what cannot be read of it, and where.
    """

    type: str = ""
    writable: bool = False
    value: int | None = None
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class ObjectDictionary:
    """Entries by (index, sub-index), the identity in the file (0 if not stated), and warnings."""

    entries: Mapping[Key, DictionaryEntry]
    vendor: int
    product: int
    warnings: tuple[str, ...] = ()

    @property
    def identity(self) -> list[tuple[int, str, int]]:
        """Vendor and product, if given in 1018h or [DeviceInfo]: sub-index, name, number."""
        return [
            (sub, name, number)
            for sub, name, stated in ((1, "vendor", self.vendor), (2, "product", self.product))
            if (IDENTITY, sub) in self.entries
            and (number := self.entries[IDENTITY, sub].value or stated)
        ]


@lru_cache(maxsize=32)
def load_dictionary(data: bytes, place: str, node: int) -> ObjectDictionary:
    """Read types, access and values of an object dictionary (EDS or DCF, CiA 306)
    by index and sub-index.

    `data` is the file's content, `node` replaces `$NODEID`. What cannot be read of an entry is
    its `problem`, for those who need it. Raises `BadInputError` with `place`, the file's name, and
    the line: a section or a key is there twice, or the file holds no objects.
    """
    Location(place).require(
        len(data) <= MAX_DICTIONARY_BYTES,
        text=f"the file has {len(data)} bytes",
        expected=f"at most {MAX_DICTIONARY_BYTES}",
    )
    # Texts in other encodings are only names: numbers are the same in all of them.
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
    """A file's `sections` by their names in capitals, and its entries as canopen reads them.

    What canopen refuses, or reads otherwise, is changed before: lines that say nothing, numbers
    with leading zeros, compact storage.
    """

    def __init__(self, text: str, place: str, node: int) -> None:
        # canopen's warnings about readable files would be printed between our own output.
        logging.getLogger("canopen").addHandler(logging.NullHandler())
        self._place, self._node = place, node
        # The first lines may be in no section.
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
        """Return the lines that describe each entry, and the section and the key of its value.

        Those of sub-indices come after their object, in whose lines nothing may stand. Compact
        storage (CiA 306: CompactSubObj) is written out: all sub-indices have the lines of their
        object, and the values of a section such as [1A00Value].
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

        # What canopen would not do without, and what nobody needs.
        given = {"parametername": "", "accesstype": "", **lines, "pdomapping": "0"}
        self._parser["-"] = given | {"defaultvalue": lines.get(key, "")}
        try:
            found = eds.build_variable(self._parser, "-", self._node, 0)
        except (configparser.Error, ValueError):
            return DictionaryEntry(problem=self._problem(lines, section, "datatype"))
        type_ = INTEGERS.get(found.data_type, "")
        # Python's own numbers may have underscores.
        known = type_ and isinstance(found.default, int) and "_" not in lines[key]
        return DictionaryEntry(
            type=type_,
            writable="w" in found.access_type,
            value=found.default if known else None,
            problem="" if known or not type_ else self._problem(lines, section, key),
        )

    def _problem(self, lines: Lines, section: str, key: str) -> str:
        """Say where a key is that has no number; empty if it is missing."""
        found = key in lines and re.search(rf"(?ims)^\[{section}\].*?^({key})[ \t]*=", self._text)
        if not found:
            return ""
        problem = f"= {lines[key]!r} is not a number" if lines[key] else "is empty"
        line = self._text.count("\n", 0, found.start(1))
        return f"{self._place}: line {line}: {found[1]} {problem}"
