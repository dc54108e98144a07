"""EDS and DCF files (CiA 306) as plain values; errors of canopen's importer are reported in one line."""

import configparser
import io
import logging
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from ..errors import Place
from .objects import INTEGERS

IDENTITY = 0x1018
LARGEST_DICTIONARY = 4 * 2**20  # bytes
# Numbers of [DeviceInfo] that files leave empty; the importer fails on them.
_EMPTY = re.compile(
    r"^(VendorNumber|ProductNumber|RevisionNumber|NrOf[RT]XPDO|BaudRate_\d+|SimpleBootUp(?:Master|Slave)|Granularity"
    r"|DynamicChannelsSupported|GroupMessaging|LSS_Supported)[ \t]*=[ \t]*(?=(?:;.*)?\r?$)",
    re.IGNORECASE | re.MULTILINE,
)


@dataclass(frozen=True, kw_only=True)
class DictionaryEntry:
    """An entry: `type` is I8 to U32, or empty for what no PDO can carry; `value` is the DCF's value or the default."""

    type: str
    writable: bool
    value: int | None


@dataclass(frozen=True, kw_only=True)
class ObjectDictionary:
    """Entries by (index, sub-index), the identity the file states (0 where it states none), and warnings."""

    entries: Mapping[tuple[int, int], DictionaryEntry]
    vendor: int
    product: int
    warnings: tuple[str, ...] = ()

    @property
    def identity(self) -> list[tuple[int, str, int]]:
        """Vendor and product as far as they are stated, in 1018h or in [DeviceInfo]: sub-index, name, number."""
        found = []
        for sub, name, number in ((1, "vendor", self.vendor), (2, "product", self.product)):
            entry = self.entries.get((IDENTITY, sub))
            if entry is not None and (entry.value or number):
                found.append((sub, name, entry.value or number))
        return found


@lru_cache(maxsize=32)
def load_dictionary(data: bytes, place: str, node: int) -> ObjectDictionary:
    """Types, access and values of an object dictionary (EDS or DCF, CiA 306) by index and sub-index.

    `data` is the file's content, `node` the id that `$NODEID` stands for. Raises `AcquisitionError` with `place`, the file's
    name, and the line where it cannot be read, holds an entry twice, or holds no objects.
    """
    import canopen
    from canopen import objectdictionary

    file = Place(place)
    # Its warnings about files that it can read would be printed among our own output.
    logging.getLogger("canopen").addHandler(logging.NullHandler())
    if len(data) > LARGEST_DICTIONARY:
        file.refuse(text=f"{len(data)} bytes", expected=f"{LARGEST_DICTIONARY} at most")
    text = data.decode("utf-8-sig", errors="replace")
    empty = [(text.count("\n", 0, found.start()) + 1, found[1]) for found in _EMPTY.finditer(text)]
    source = io.StringIO(_EMPTY.sub(r"\g<0>0x0 ", text))
    source.name = "dictionary.eds"  # the importer goes by the suffix
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = canopen.import_od(source, node)
    except (configparser.DuplicateOptionError, configparser.DuplicateSectionError) as error:
        option = getattr(error, "option", None)
        problem = f"[{error.section}] {'is there' if option is None else f'holds {option!r}'} twice"
        Place(f"{place}: line {error.lineno}").refuse(text=problem, expected="once; remove one")
    except Exception as error:  # on a damaged file the importer raises errors of any kind
        problem = str(error) or type(error).__name__
        file.refuse(text=f"not an EDS or DCF that can be read: {problem[:200]}")
    entries = {}
    for item in found.values():
        parts = [item] if isinstance(item, objectdictionary.ODVariable) else list(item.values())
        for part in parts:
            value = part.value if part.value is not None else part.default
            entries[part.index, part.subindex] = DictionaryEntry(
                type=INTEGERS.get(part.data_type or 0, ""),
                writable="w" in (part.access_type or ""),
                value=value if isinstance(value, int) else None,
            )
    if not entries:
        file.refuse(text="holds no objects", expected="an EDS or DCF")
    about = found.device_information
    return ObjectDictionary(
        entries=entries,
        vendor=about.vendor_number or 0,
        product=about.product_number or 0,
        warnings=tuple(f"{place}: line {line}: {key} is empty: read as 0, which is not checked" for line, key in empty),
    )
