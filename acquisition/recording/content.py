"""The container of a recording, whole or truncated.

It is read, and its version and every checksum are checked, but not the meaning of its messages.

The readers of mcap are not used: they raise the same errors for truncation and for damage, do not
check the CRCs of attachments, and unpack chunks of any size. Format: https://mcap.dev/spec.

Other programs rewrite recordings (`mcap recover`, `filter`, `merge`, `compress`): chunks may be
compressed by zstd or lz4 or not at all, and messages may be outside of chunks.
"""

import hashlib
import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import mcap.records
import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from ..errors import Location
from ..files import NAMES, GrowingBytes, kind_of
from .rows import CAPTURE_TOPIC
from .writer import FRAMES_TOPIC, SCHEMA_VERSION, metadata_crc

_MAGIC = b"\x89MCAP0\r\n"
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
# The most bytes of a chunk, which is written at about 1 MiB, and of all chunks unpacked. Larger
# sizes are hostile or damaged.
_MAX_CHUNK_BYTES, _MAX_TOTAL_BYTES = 64 * 2**20, 4 * 2**30
# Only viewers need the other topics.
READ_TOPICS = re.compile(f"/samples|/events|/health|{CAPTURE_TOPIC}|{FRAMES_TOPIC.pattern}")
_MERGED = "merged recordings cannot be read"
# Unpackers of a chunk by its compression; they return at most so many bytes.
_UNPACKED: Mapping[str, Callable[[bytes, int], bytes]] = {
    "": lambda data, most: data,
    "zstd": lambda data, most: (
        zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True).read(most)
    ),
    "lz4": lambda data, most: LZ4FrameDecompressor().decompress(data, max_length=most),
}
# Errors that damaged bytes raise; lz4 raises RuntimeError.
_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    RuntimeError,
    struct.error,
    ValueError,
    MemoryError,
    OverflowError,
)


class _ForeignError(ValueError):
    """Content that another program may write, and that is not a recording of this package.

    Such content is not damage either.
    """


class Messages:
    """Messages of one topic, in file order.

    They have the text of their schema, their log times in ns, and their contents.
    """

    def __init__(self, layout: str) -> None:
        self.layout = layout
        self.stamps_ns: list[int] = []
        # All contents are in one buffer, each up to its entry in `ends`, because hours of samples
        # do not fit in memory.
        self.data, self.ends = GrowingBytes(), list[int]()

    def add(self, stamp_ns: int, content: bytes) -> None:
        """Append a message."""
        self.data.write(content)
        self.stamps_ns.append(stamp_ns)
        self.ends.append(self.data.tell())

    def items(self) -> Iterator[tuple[int, bytes]]:
        """Yield log time and content of each message."""
        data = self.data.whole()
        for stamp_ns, begin, end in zip(self.stamps_ns, [0, *self.ends], self.ends, strict=False):
            yield stamp_ns, bytes(data[begin:end])


def read_content(path: Path) -> tuple["Content", bool, str]:
    """Read the content of a recording, whether the file is truncated, and its SHA-256.

    For a file without its end this is what was written before.

    Raises
    ------
    BadInputError : the file cannot be read, is not MCAP, is damaged, or fails `check_metadata`.
    """
    try:
        with path.open("rb") as file:
            return _read(_Records(file), path)
    except OSError as error:
        Location(str(path)).refuse(text=f"the file cannot be read: {error.strerror}")


def _read(records: "_Records", path: Path) -> tuple["Content", bool, str]:
    place = Location(str(path))
    if records.first != _MAGIC:
        ending, kind = path.suffix.lower(), kind_of(path).replace("mcap", "")
        place.require(
            ending not in (".csv", ".mat", ".log", ".asc", ".blf", ".trc", ".db3"),
            text=f"this is a {ending[1:].upper()} file, not a recording",
            advice=f"Import it first: `robot-acquire import {path} --robot ROBOT.toml`, or by "
            f"`robot-identify fit {path} ROBOT.urdf`",
        )
        place.refuse(
            text=f"this is {NAMES[kind]}, not a recording" if kind else "this is not an MCAP file",
            advice="Pass a recording of `robot-acquire record` or `robot-acquire import`",
        )
    found = Content(str(path))
    for opcode, at, content in records:
        try:
            found.add(opcode, content, records.crc_before)
            if found.complete:
                break
        except _DAMAGE as error:
            if not records.has_end and records.only_zeros_follow():
                # The last record of a truncated file is incomplete, and followed by nothing or by
                # unwritten disk space.
                break
            place.refuse(
                text=(
                    ""
                    if isinstance(error, _ForeignError)
                    else f"the file is damaged at byte {at}: "
                )
                + (str(error) or type(error).__name__)
            )
    if records.has_end and not found.complete:
        place.refuse(text="the file is damaged: its records do not lead to its end")
    return found, not records.has_end, records.sha256()


class Content:
    """Content of the records so far.

    `recording` is the metadata record, or None without it. Attachments are given by name, and
    messages by topic of `READ_TOPICS`. `complete` is True after the last record with data.
    """

    def __init__(self, place: str) -> None:
        self._place = place
        self.metadata: dict[str, str] | None = None
        self.attachments: dict[str, bytes] = {}
        self.messages: dict[str, Messages] = {}
        self.complete, self._size = False, 0
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, str | None] = {}  # topic by channel id; None: not one to read

    def take(self) -> dict[str, Messages]:
        """Return the messages since the last call."""
        taken, self.messages = (
            self.messages,
            {topic: Messages(m.layout) for topic, m in self.messages.items()},
        )
        return taken

    def add(self, opcode: int, content: bytes, crc_before: int | None = None) -> None:
        """Add a record; raise one of `_DAMAGE` if it is wrong.

        `crc_before` is the CRC of all bytes before it, if known.
        """
        if opcode == Opcode.METADATA:
            record = mcap.records.Metadata.read(_stream(content))
            if record.name == "recording":
                if self.metadata is not None:
                    raise _ForeignError(
                        f"it has a second metadata record {record.name!r}: {_MERGED}"
                    )
                self.metadata = dict(record.metadata)
                check_metadata(self.metadata, self._place)
        elif opcode == Opcode.ATTACHMENT:
            record = mcap.records.Attachment.read(_stream(content))
            _check_crc(zlib.crc32(content[:-4]), int.from_bytes(content[-4:], "little"))
            if record.name in self.attachments:
                raise _ForeignError(f"it has a second attachment {record.name!r}: {_MERGED}")
            self.attachments[record.name] = record.data
        elif opcode == Opcode.CHUNK:
            content = _unpack(mcap.records.Chunk.read(_stream(content)))
            self._size += len(content)
            if self._size > _MAX_TOTAL_BYTES:
                raise ValueError(f"chunks unpack to more than {_MAX_TOTAL_BYTES} bytes")
            for inner, _, part in _records(BytesIO(content).read, 0, len(content)):
                self._add_message(inner, part)
        elif opcode == Opcode.DATA_END:
            if crc_before is not None:
                _check_crc(crc_before, int.from_bytes(content[:4], "little"))
            self.complete = True
        else:
            self._add_message(opcode, content)

    def _add_message(self, opcode: int, content: bytes) -> None:
        """Add a record with a message, a schema or a channel; others are skipped."""
        if opcode == Opcode.MESSAGE:
            number, _, stamp_ns, _ = _MESSAGE.unpack_from(content)
            if number not in self._channels:
                raise ValueError(f"a message has the channel {number}, which is not described")
            if (topic := self._channels[number]) is not None:
                self.messages[topic].add(stamp_ns, content[_MESSAGE.size :])
        elif opcode == Opcode.SCHEMA:
            schema = mcap.records.Schema.read(_stream(content))
            # Schemas of other topics may have any bytes.
            self._schemas[schema.id] = schema.data.decode(errors="replace")
        elif opcode == Opcode.CHANNEL:
            channel = mcap.records.Channel.read(_stream(content))
            layout, self._channels[channel.id] = self._schemas.get(channel.schema_id, ""), None
            if READ_TOPICS.fullmatch(channel.topic):
                self._channels[channel.id] = channel.topic
                if self.messages.setdefault(channel.topic, Messages(layout)).layout != layout:
                    raise _ForeignError(f"the layout of {channel.topic} changes: {_MERGED}")


class GrowingContent(Content):
    """Content of a file that another program is writing, without a lock.

    `read` adds the records since the last call. It raises `BadInputError` if the file is not one
    that is being written, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._path, self._file, self._at = path, path.open("rb"), len(_MAGIC)

    def read(self) -> bool:
        """Read new records; return whether there were any."""
        place, before = Location(str(self._path)), self._at
        try:
            there, ours = self._path.stat(), os.fstat(self._file.fileno())
        except FileNotFoundError:
            place.refuse(text="the recording was moved or deleted while it was written")
        place.require(
            os.path.samestat(there, ours), text="the recording was replaced by another file"
        )
        place.require(
            there.st_size >= self._at,
            text=f"the recording was truncated to {there.st_size} bytes, after {self._at} bytes "
            "had been read",
        )
        self._file.seek(0)
        place.require(self._file.read(len(_MAGIC)) == _MAGIC, text="this is not a recording")
        self._file.seek(self._at)
        data = self._file.read(_MAX_CHUNK_BYTES)
        for opcode, at, content in _records(BytesIO(data).read, before, before + len(data)):
            try:
                self.add(opcode, content)
            except _DAMAGE as error:
                place.refuse(text=f"the file is damaged at byte {at}: {error}")
            self._at = at + len(content)
        return self._at > before


class _Records:
    """The complete records of a file, one at a time, as `_records` yields them."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._digest = hashlib.sha256()
        # A record is read in two parts, head and content. These are the CRCs of all bytes before
        # the current record, before the last part, and including it.
        self.crc_before, self._crc_before_part, self._crc = 0, 0, 0
        file.seek(max(0, self._size - len(_MAGIC)))
        self.has_end = self._size > 2 * len(_MAGIC) and file.read() == _MAGIC
        file.seek(0)
        self.first = self._take(len(_MAGIC))

    def __iter__(self) -> Iterator[tuple[int, int, bytes]]:
        return _records(self._take, len(_MAGIC), self._size)

    def only_zeros_follow(self) -> bool:
        """Test whether nothing but zero bytes follows the current record."""
        return all(not part.strip(b"\0") for part in self._rest())

    def sha256(self) -> str:
        """Compute the digest of the whole file, hexadecimal."""
        for _ in self._rest():
            pass
        return self._digest.hexdigest()

    def _rest(self) -> Iterator[bytes]:
        while part := self._take(2**20):
            yield part

    def _take(self, length: int) -> bytes:
        part = self._file.read(length)
        self._digest.update(part)
        self.crc_before, self._crc_before_part = self._crc_before_part, self._crc
        self._crc = zlib.crc32(part, self._crc)
        return part


def _records(take: Callable[[int], bytes], at: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield opcode, first byte of the content, and content of each complete record.

    They are in the bytes from `at` to `end`, which `take` returns in order. Opcode 0 is unwritten
    disk space and ends the iteration.
    """
    while at + 9 <= end:
        head = take(9)
        length = int.from_bytes(head[1:], "little")
        if head[0] == 0 or at + 9 + length > end:
            return
        at += 9 + length
        yield head[0], at - length, take(length)


def _stream(content: bytes) -> Any:
    return ReadDataStream(BytesIO(content))


def _check_crc(computed: int, expected: int) -> None:
    if expected not in (0, computed):  # 0: no CRC was written
        raise ValueError(f"the CRC is {computed:08x}, expected {expected:08x}")


def _unpack(chunk: Any) -> bytes:
    """Unpack the records of a chunk.

    Neither format needs to contain the size, so no more is unpacked than the chunk declares.
    """
    if chunk.compression not in _UNPACKED:
        raise _ForeignError(
            f"its chunks are compressed by {chunk.compression!r}: expected 'zstd', 'lz4' or none, "
            "as `mcap compress` writes them"
        )
    size = min(chunk.uncompressed_size, _MAX_CHUNK_BYTES)
    content = _UNPACKED[chunk.compression](chunk.data, size + 1)
    if len(content) != size or chunk.uncompressed_size != size:
        raise ValueError(f"a chunk has {len(content)} bytes, expected {size}")
    _check_crc(zlib.crc32(content), chunk.uncompressed_crc)
    return content


def check_metadata(metadata: Mapping[str, str], place: str) -> None:
    """Refuse a recording of a newer version, or with damaged metadata."""
    text = metadata.get("schema_version", "")
    Location(place).require(
        re.fullmatch("[0-9]{1,9}", text, re.ASCII) and int(text) >= 1,
        "schema_version",
        text,
        "a whole number of at least 1",
    )
    Location(place).require(
        int(text) <= SCHEMA_VERSION,
        "schema_version",
        int(text),
        f"at most {SCHEMA_VERSION}",
        text="a newer version of robot-idim wrote this file",
        advice="Update robot-idim",
    )
    Location(f"{place}: metadata").require(
        metadata.get("crc32") == metadata_crc(metadata),
        "crc32",
        metadata.get("crc32"),
        repr(metadata_crc(metadata)),
        text="the metadata are damaged",
    )
