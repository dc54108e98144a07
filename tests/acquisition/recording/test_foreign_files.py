"""Recordings as other programs write them again: `mcap recover`, `filter`, `merge`, `compress`.

The library of the format's authors reads and writes them here.
"""

import struct
from collections.abc import Callable

import lz4.frame
import pytest
import zstandard
from made_up_buses import bus_text, flat, robot_of, session
from made_up_recordings import attempt, header, same, write, written_again
from mcap.writer import CompressionType, Writer

from acquisition.commands import main
from acquisition.errors import BadInputError
from acquisition.importing import import_recording
from acquisition.recording import RecordingFollower, RecordingWriter, read_recording

EVENTS, SAMPLES = "/events", "/samples"


def with_chunks(data: bytes, compression: str, compress: Callable[[bytes], bytes]) -> bytes:
    """A file of chunks by zstd with others in their place; checksums of the file are left out."""
    at, out = 8, bytearray(data[:8])
    while data[at] != 0x0F:  # the end of the data
        size = int.from_bytes(data[at + 1 : at + 9], "little")
        record = data[at + 9 : at + 9 + size]
        if data[at] == 6:
            packed = compress(zstandard.decompress(record[44:]))
            name = struct.pack("<I", len(compression)) + compression.encode()
            record = record[:28] + name + struct.pack("<Q", len(packed)) + packed
        if data[at] != 7:  # indices of messages may be left out
            out += data[at : at + 1] + struct.pack("<Q", len(record)) + record
        at += 9 + size
    end = b"\x0f" + struct.pack("<QI", 4, 0) + b"\x02" + struct.pack("<Q", 20) + bytes(20)
    return bytes(out + end + data[:8])


def without_size(content: bytes) -> bytes:
    """By zstd as a program in Go writes it: the size is not known at the beginning."""
    packer = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    return bytes(packer.compress(content) + packer.flush())


@pytest.mark.parametrize("compression", [*CompressionType])
@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("chunk_bytes", [2**20, 500])
def test_rewritten_file_is_read(tmp_path, whole, compression, chunked, chunk_bytes):
    how = {"compression": compression, "use_chunking": chunked, "chunk_size": chunk_bytes}
    path = written_again(whole, tmp_path / "a.mcap", **how)
    assert same(read_recording(path), read_recording(whole))


@pytest.mark.parametrize(
    ("compression", "compress"),
    [
        ("zstd", without_size),
        ("zstd", lambda content: without_size(content[:100]) + zstandard.compress(content[100:])),
        ("", bytes),
        ("lz4", lz4.frame.compress),
        ("lz4", lambda content: lz4.frame.compress(content, store_size=False)),
    ],
)
def test_chunk_size_is_optional(tmp_path, whole, compression, compress):
    (tmp_path / "a.mcap").write_bytes(with_chunks(whole.read_bytes(), compression, compress))
    assert same(read_recording(tmp_path / "a.mcap"), read_recording(whole))


@pytest.mark.parametrize(
    ("compression", "compress", "problem"),
    [
        ("zstd", lambda x: without_size(x + bytes(10**7)), r"a chunk has \d+ bytes, expected"),
        ("zstd", lambda x: without_size(x)[:-4], r"damaged at byte .* a chunk has \d+ bytes"),
        ("lz4", lambda x: lz4.frame.compress(x + bytes(10**7)), r"a chunk has \d+ bytes, expected"),
        ("lz4", lambda x: lz4.frame.compress(x)[:-9], r"damaged at byte .* a chunk has \d+ bytes"),
        ("lz4", lambda x: b"\x04\x22\x4d\x18" + x, "damaged at byte .* LZ4"),
        ("", lambda x: x[:-1], r"a chunk has \d+ bytes, expected"),
        ("", lambda x: x[:-1] + b"\7", "CRC is"),
        ("br", bytes, r"a\.mcap: its chunks are compressed by 'br': expected 'zstd', 'lz4' or"),
    ],
)
def test_inconsistent_chunks(tmp_path, whole, compression, compress, problem):
    (tmp_path / "a.mcap").write_bytes(with_chunks(whole.read_bytes(), compression, compress))
    with pytest.raises(BadInputError, match=problem):
        read_recording(tmp_path / "a.mcap")


def message(topic: str, data: bytes, schema: bytes) -> Callable[[Writer], None]:
    def add(writer: Writer) -> None:
        number = writer.register_schema("x", "protobuf", schema)
        writer.add_message(writer.register_channel(topic, "", number), 10**9, data, 10**9)

    return add


def test_foreign_topics_are_accepted(tmp_path, whole):
    """A schema of protobuf is no text."""
    path = written_again(whole, tmp_path / "a.mcap", message("/camera", b"\xff" * 9, b"\n\xff\xfe"))
    assert same(read_recording(path), read_recording(whole))


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        (message(EVENTS, b"{}", b"other"), f"the layout of {EVENTS} changes: merged recordings"),
        (message(SAMPLES, b"", b"[]"), f"the layout of {SAMPLES} changes: merged recordings"),
        (lambda w: w.add_metadata("recording", {}), "a second metadata record 'recording'"),
        (lambda w: w.add_attachment(0, 0, "robot.toml", "", b""), "a second attachment 'robot"),
    ],
)
def test_merged_recordings_are_not_damaged(tmp_path, whole, more, problem):
    told = attempt(written_again(whole, tmp_path / "a.mcap", more))
    assert isinstance(told, str)
    assert problem in told
    assert "damaged" not in told


@pytest.mark.parametrize("share", [0.4, 0.7])
def test_records_outside_chunks_are_read(tmp_path, whole, share):
    data = written_again(whole, tmp_path / "a.mcap", use_chunking=False).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(share * len(data))])
    cut, full = read_recording(tmp_path / "cut.mcap"), read_recording(whole)
    assert cut.cut
    assert 0 < len(cut.samples) < len(full.samples)
    assert full.samples.tobytes().startswith(cut.samples.tobytes())


def test_file_without_chunks_is_followed(tmp_path):
    robot, frames = robot_of(bus_text(2)), flat(session(syncs=60))
    with RecordingWriter(tmp_path / "a.mcap", header(robot)) as writer:
        writer.frames("can0", frames)
    data = written_again(tmp_path / "a.mcap", tmp_path / "b.mcap", use_chunking=False).read_bytes()
    path = tmp_path / "growing.mcap"
    path.write_bytes(data[: len(data) // 2])
    follower, rows = RecordingFollower(path), []
    for part in (data[: len(data) * 3 // 4], data):
        path.write_bytes(part)
        follower.read()
        rows += [] if follower.rows is None else follower.rows["stamp_ns"].tolist()
    assert follower.ended
    assert rows == frames["time_ns"][frames["can_id"] == 0x80].tolist()


@pytest.mark.parametrize("of_blocks", [0, 1, 2])
def test_recovery_of_nothing_fails(tmp_path, robot, of_blocks, capsys):
    """Of a description alone, with events too, and of a first block that is not whole."""
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    write(cut, robot, blocks=1)
    data = cut.read_bytes()
    first = data.index(b"\x06", data.index(b"[FileInfo]"))
    if of_blocks == 1:
        with RecordingWriter(cut, header(robot)) as writer:
            writer.event(0, "phase", "track")
            writer.flush()
            data = cut.read_bytes()
    cut.write_bytes(data[: (first, -9, first + 40)[of_blocks]])
    assert main(["import", str(cut), "-o", str(out)]) == 1
    assert f"{cut}: the recording is truncated before its first sample" in capsys.readouterr().err
    assert not out.exists()


def test_recovery_of_frames_alone_succeeds(tmp_path, robot):
    """Also of frames that do not decode: they are what the recording is for."""
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    write(cut, robot, blocks=1)
    (frames,) = read_recording(cut).frames.values()
    with RecordingWriter(cut, header(robot)) as writer:
        writer.frames("can0", frames)
    cut.write_bytes(cut.read_bytes()[:-9])
    found = read_recording(import_recording(cut, out).out)
    assert found.samples is None
    assert (found.frames["can0"] == frames).all()
