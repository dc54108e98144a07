"""Object dictionaries in files: EDS and DCF (CiA 306)."""

import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

from ..errors import Place
from .objects import INTEGERS
from .transfers import Key

IDENTITY = 0x1018
MAX_DICTIONARY_BYTES = 4 * 2**20
# A section or `key = value`; a remark follows a space.
_LINE = re.compile(
    r"\[(?P<name>.*?)\].*|(?P<key>[^=;#]+?)\s*=\s*(?P<value>.*?)\s*(?:(?<![^\s=]);.*)?"
)
_ENTRY = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?")
# Octal numbers and decimal ones with leading zeros are the same up to 7: others are not read.
_NUMBER = re.compile(
    r"(\$NODEID\+)?(?:(-?(?:0X[0-9A-F]{1,16}|[1-9][0-9]{0,19}))|0*([0-9]))(\+\$NODEID)?"
)
Lines: TypeAlias = dict[
    str, tuple[int, str]
]  # number of the line and value, by key in small letters


@dataclass(frozen=True, kw_only=True)
class DictionaryEntry:
    """An entry: `type` is I8 to U32, or empty if no PDO can carry it; `value` is the
    DCF's value or the default; `problem` says what cannot be read of it, and where.
    """

    type: str
    writable: bool
    value: int | None
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
        """Vendor and product, if stated in 1018h or [DeviceInfo]: sub-index, name, number."""
        found = []
        for sub, name, number in ((1, "vendor", self.vendor), (2, "product", self.product)):
            entry = self.entries.get((IDENTITY, sub))
            if entry is not None and (entry.value or number):
                found.append((sub, name, entry.value or number))
        return found


@lru_cache(maxsize=32)
def load_dictionary(data: bytes, place: str, node: int) -> ObjectDictionary:
    """Read types, access and values of an object dictionary (EDS or DCF, CiA 306)
    by index and sub-index.

    `data` is the file's content, `node` replaces `$NODEID`. What cannot be read of an entry is
    its `problem`, for those who need it. Raises `BadInputError` with `place`, the file's name, and
    the line: a section or a key is there twice, or the file holds no objects.
    """
    if len(data) > MAX_DICTIONARY_BYTES:
        Place(place).refuse(text=f"{len(data)} bytes", expected=f"{MAX_DICTIONARY_BYTES} at most")
    # Texts in other encodings are only names: numbers are the same in all of them.
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    sections = _sections(data.decode(encoding, errors="replace"), place)
    entries = {}
    for key, lines in _contents(sections):
        kind = _number(lines, "DataType")
        if isinstance(kind, int) and kind > 0x1B:  # not of CiA 301: so an editor writes ranges
            kind = _number(sections.get(f"{kind:x}sub1", {}), "DefaultValue")
        stated = "ParameterValue" if lines.get("parametervalue", (0, ""))[1] else "DefaultValue"
        value, type_ = (
            _number(lines, stated, node),
            INTEGERS.get(kind, "") if isinstance(kind, int) else "",
        )
        problem = next((text for text in (kind, value) if text and isinstance(text, str)), "")
        entries[key] = DictionaryEntry(
            type=type_,
            writable="w" in lines.get("accesstype", (0, ""))[1].lower(),
            value=value if type_ and isinstance(value, int) else None,
            problem=problem and f"{place}: {problem}",
        )
    if not entries:
        Place(place).refuse(text="holds no objects", expected="an EDS or DCF")
    about = sections.get("deviceinfo", {})
    vendor, product = (_number(about, key) for key in ("VendorNumber", "ProductNumber"))
    return ObjectDictionary(
        entries=entries,
        vendor=vendor if isinstance(vendor, int) else 0,
        product=product if isinstance(product, int) else 0,
        warnings=tuple(
            f"{place}: {text}: read as 0, which is not checked"
            for text in (vendor, product)
            if text and isinstance(text, str)
        ),
    )


def _sections(text: str, place: str) -> dict[str, Lines]:
    """The lines of the sections, by their names in small letters; that of the name has no key."""
    found, name = dict[str, Lines](), ""
    for number, line in enumerate(io.StringIO(text, None), 1):
        if (parts := _LINE.fullmatch(line.strip())) is None:
            continue
        name = name if parts["name"] is None else parts["name"].strip()
        lines, key = found.setdefault(name.lower(), {}), parts["key"] or ""
        if key.lower() in lines:
            text = f"[{name}] {f'holds {key!r}' if key else 'is there'} twice"
            Place(f"{place}: line {number}").refuse(text=text, expected="once; remove one")
        lines[key.lower()] = number, parts["value"] or ""
    return found


def _contents(sections: Mapping[str, Lines]) -> Iterator[tuple[Key, Lines]]:
    """The lines that describe each entry. Compact storage (CiA 306: CompactSubObj) is written out:
    all sub-indices have the lines of their object, and the values of a section such as [1A00Value].
    """
    for name, lines in sections.items():
        if (found := _ENTRY.fullmatch(name)) is None:
            continue
        index, sub = int(found[1], 16), found[2]
        if sub is None and "compactsubobj" in lines and _number(lines, "CompactSubObj") != 0:
            count, listed = _number(lines, "CompactSubObj"), sections.get(f"{name}value", {})
            yield (index, 0), {"datatype": (0, "5"), "defaultvalue": lines["compactsubobj"]}
            for k in range(1, min(count, 254) + 1 if isinstance(count, int) else 1):
                own = {"parametervalue": listed[str(k)]} if str(k) in listed else {}
                yield (index, k), lines | own
        elif sub is not None or _number(lines, "ObjectType") not in (8, 9):  # arrays, records
            yield (index, int(sub or "0", 16)), lines


def _number(lines: Lines, key: str, node: int = 0) -> int | str:
    """The number of a key, or why it cannot be read; an empty text where the key is missing."""
    line, text = lines.get(key.lower(), (0, ""))
    found = _NUMBER.fullmatch("".join(text.upper().split()))
    if found is None:
        problem = f"= {text!r} is no number" if text else "is empty"
        return f"line {line}: {key} {problem}" if line else ""
    return int(found[2] or found[3], 0) + (node if found[1] or found[4] else 0)
