"""What stands in an MCAP file, whole or cut, with every checksum checked: the container, not the meaning.

The records are walked here, not by mcap's own readers: those stop with the same errors at a cut and at damage, check no
attachment's CRC, and let a chunk unpack to any size. Format: https://mcap.dev/spec.
"""

import hashlib
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import mcap.records
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from . import AcquisitionError

_MAGIC = b"\x89MCAP0\r\n"
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_LARGEST_CHUNK = 64 * 2**20  # bytes; chunks are written at about 1 MiB, so more is a hostile or damaged size
_LARGEST_TOTAL = 4 * 2**30  # bytes of all chunks unpacked
_DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, MemoryError, OverflowError)


@dataclass(frozen=True, kw_only=True)
class Messages:
    """Messages of one topic: the text of their schema, then log time in ns and content of each, in file order."""

    layout: str
    items: list[tuple[int, bytes]]


@dataclass(frozen=True, kw_only=True)
class Content:
    """`metadata` is `None` where the record asked for is missing; `cut` says that the file has no proper end."""

    metadata: Mapping[str, str] | None
    attachments: Mapping[str, bytes]
    messages: Mapping[str, Messages]
    cut: bool
    sha256: str


def read_content(
    path: Path, name: str, accept: Callable[[Mapping[str, str], str], None], wanted: Callable[[str], bool]
) -> Content:
    """Read the metadata record `name`, all attachments, and the messages of the `wanted` topics.

    `accept(metadata, place)` raises to refuse the file before its data is looked at. A file without its end gives what
    stands before the cut. Raises `AcquisitionError` when the file cannot be read, is not MCAP, or is damaged.
    """
    place = str(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise AcquisitionError(f"{place}: cannot be read: {error.strerror}") from error
    if not data.startswith(_MAGIC):
        raise AcquisitionError(f"{place}: begins with {data[:8]!r}: expected an MCAP file")
    has_end = len(data) > 2 * len(_MAGIC) and data.endswith(_MAGIC)
    metadata: dict[str, str] | None = None
    attachments: dict[str, bytes] = {}
    chunks = _Chunks(wanted)
    complete = False
    for opcode, begin, end in _records(data, len(_MAGIC)):
        try:
            if opcode == Opcode.METADATA:
                record = mcap.records.Metadata.read(_stream(data, begin, end))
                if record.name == name:
                    if metadata is not None:
                        raise ValueError(f"a second metadata record {name!r}")
                    metadata = dict(record.metadata)
                    accept(metadata, place)
            elif opcode == Opcode.ATTACHMENT:
                record = mcap.records.Attachment.read(_stream(data, begin, end))
                _check_crc(data[begin : end - 4], data[end - 4 : end])
                if record.name in attachments:
                    raise ValueError(f"a second attachment {record.name!r}")
                attachments[record.name] = record.data
            elif opcode == Opcode.CHUNK:
                chunks.add(mcap.records.Chunk.read(_stream(data, begin, end)))
            elif opcode == Opcode.DATA_END:
                _check_crc(data[: begin - 9], data[begin : begin + 4])
                complete = True
                break
        except _DAMAGE as error:
            if not has_end and not data[end:].strip(b"\0"):
                break  # the last record of a cut file: torn, with nothing or unwritten disk space behind it
            what = str(error) or type(error).__name__
            raise AcquisitionError(f"{place}: damaged at byte {begin}: {what}") from error
    if has_end and not complete:
        raise AcquisitionError(f"{place}: damaged: its end is there, but the records before do not lead to it")
    return Content(
        metadata=metadata,
        attachments=attachments,
        messages=chunks.messages,
        cut=not has_end,
        sha256=hashlib.sha256(data).hexdigest(),
    )


def _records(data: bytes, at: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, first and last byte of every record whose content is all there. Opcode 0 is unwritten disk space."""
    while at + 9 <= len(data) and data[at] != 0:
        begin = at + 9
        end = begin + int.from_bytes(data[at + 1 : begin], "little")
        if end > len(data):
            return
        yield data[at], begin, end
        at = end


def _stream(data: bytes, begin: int, end: int) -> Any:
    return ReadDataStream(BytesIO(data[begin:end]))


def _check_crc(content: bytes, crc: bytes) -> None:
    expected = int.from_bytes(crc, "little")
    if expected not in (0, zlib.crc32(content)):  # 0 says that no CRC was written
        raise ValueError(f"CRC is {zlib.crc32(content):08x}: expected {expected:08x}")


class _Chunks:
    """The chunks read so far: their channels, and the messages of the wanted topics."""

    def __init__(self, wanted: Callable[[str], bool]) -> None:
        self._wanted, self._size = wanted, 0
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, list[tuple[int, bytes]] | None] = {}  # where messages go; None: they are not wanted
        self.messages: dict[str, Messages] = {}

    def add(self, chunk: Any) -> None:
        content = _unpacked(chunk)
        self._size += len(content)
        if self._size > _LARGEST_TOTAL:
            raise ValueError(f"more than {_LARGEST_TOTAL} bytes unpacked")
        for opcode, begin, end in _records(content, 0):
            if opcode == Opcode.MESSAGE:
                number, _, stamp_ns, _ = _MESSAGE.unpack_from(content, begin)
                if number not in self._channels:
                    raise ValueError(f"a message on channel {number}, which is not described")
                items = self._channels[number]
                if items is not None:
                    items.append((stamp_ns, content[begin + _MESSAGE.size : end]))
            elif opcode == Opcode.SCHEMA:
                schema = mcap.records.Schema.read(_stream(content, begin, end))
                self._schemas[schema.id] = schema.data.decode()
            elif opcode == Opcode.CHANNEL:
                self._describe(mcap.records.Channel.read(_stream(content, begin, end)))

    def _describe(self, channel: Any) -> None:
        self._channels[channel.id] = None
        if self._wanted(channel.topic):
            layout = self._schemas.get(channel.schema_id, "")
            topic = self.messages.setdefault(channel.topic, Messages(layout=layout, items=[]))
            if topic.layout != layout:
                raise ValueError(f"{channel.topic} changes its layout")
            self._channels[channel.id] = topic.items


def _unpacked(chunk: Any) -> bytes:
    if chunk.compression != "zstd":
        raise ValueError(f"compression {chunk.compression!r}: expected 'zstd'")
    size = zstandard.get_frame_parameters(chunk.data).content_size
    if size != chunk.uncompressed_size or size > _LARGEST_CHUNK:
        raise ValueError(f"a chunk of {size} bytes: expected {min(chunk.uncompressed_size, _LARGEST_CHUNK)}")
    content: bytes = zstandard.decompress(chunk.data)
    _check_crc(content, chunk.uncompressed_crc.to_bytes(4, "little"))
    return content
