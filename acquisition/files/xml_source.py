"""XML as a tree that knows where each element stands in the text, so that single elements are replaced and all else stays."""

from dataclasses import dataclass, field
from xml.parsers import expat

from ..errors import AcquisitionError

ROUNDING = 1e-18  # SI: no mass, length or inertia of a robot is so small
_QUOTES = b"\"'"


def text_of(*values: float) -> str:
    """Numbers with all their digits, separated by blanks; rounding of a zero is written as zero."""
    return " ".join(repr(float(x) if abs(x) > ROUNDING else 0.0) for x in values)


@dataclass(kw_only=True, eq=False)
class Element:
    """An element and its bytes: from `start` to `end`, its opening tag until `opened`."""

    name: str
    attributes: dict[str, str]
    start: int
    opened: int
    end: int = 0
    children: list["Element"] = field(default_factory=list)

    def child(self, name: str) -> "Element | None":
        """The first child of that name."""
        return next((c for c in self.children if c.name == name), None)

    def all(self, name: str) -> list["Element"]:
        """All children of that name."""
        return [c for c in self.children if c.name == name]


def parse_xml(source: bytes, place: str) -> Element:
    """The root of a document in UTF-8; an `AcquisitionError` that names `place` where it is not XML."""
    parser = expat.ParserCreate("utf-8")
    roots: list[Element] = []
    above: list[Element] = []

    def opened(name: str, attributes: dict[str, str]) -> None:
        start = parser.CurrentByteIndex
        element = Element(name=name, attributes=attributes, start=start, opened=_tag_end(source, start))
        (above[-1].children if above else roots).append(element)
        above.append(element)

    def closed(name: str) -> None:
        element = above.pop()
        empty = source[element.opened - 2 : element.opened] == b"/>"
        element.end = element.opened if empty else _tag_end(source, parser.CurrentByteIndex)

    parser.StartElementHandler, parser.EndElementHandler = opened, closed
    try:
        parser.Parse(source, True)
    except expat.ExpatError as error:
        raise AcquisitionError(f"not valid XML: {error}", place=place) from error
    return roots[0]


@dataclass(kw_only=True, eq=False)
class Edits:
    """Replacements of parts of a text, made all at once."""

    source: bytes
    parts: list[tuple[int, int, bytes]] = field(default_factory=list)

    def replace(self, element: Element, text: str) -> None:
        """Put `text` in the place of an element."""
        self.parts.append((element.start, element.end, text.encode()))

    def remove(self, element: Element) -> None:
        """Take an element out, with the line that it leaves empty."""
        line = self.source.rfind(b"\n", 0, element.start)
        blank = line >= 0 and not self.source[line : element.start].strip()
        self.parts.append((line if blank else element.start, element.end, b""))

    def insert(self, element: Element, text: str) -> None:
        """Put `text` behind the opening tag of an element, on a line of its own; an empty element is opened."""
        indent = self.indent(element)
        inside = f"\n{indent}  {text}"
        if element.opened == element.end:
            tag = self.source[element.start : element.opened].decode()[:-2].rstrip()
            self.replace(element, f"{tag}>{inside}\n{indent}</{element.name}>")
        else:
            self.parts.append((element.opened, element.opened, inside.encode()))

    def indent(self, element: Element) -> str:
        """The blanks before an element on its line."""
        line = self.source[self.source.rfind(b"\n", 0, element.start) + 1 : element.start].decode()
        return line if not line.strip() else line[: len(line) - len(line.lstrip())]

    def text(self) -> str:
        """The text with all replacements made."""
        made = self.source
        for start, end, part in sorted(self.parts, key=lambda part: part[0], reverse=True):
            made = made[:start] + part + made[end:]
        return made.decode()


def _tag_end(source: bytes, start: int) -> int:
    """Behind the > of the tag that starts there; > may stand in a quoted value."""
    quote = 0
    for i in range(start, len(source)):
        c = source[i]
        if quote:
            quote = 0 if c == quote else quote
        elif c in _QUOTES:
            quote = c
        elif c == ord(">"):
            return i + 1
    return len(source)
