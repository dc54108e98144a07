"""Recordings cut at any byte, damaged at any bit, or made by someone else."""

import json
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np
import pytest
from made_up_buses import bus_text, flat, robot_of, session
from made_up_recordings import attempt, is_prefix, same, write
from mcap.writer import Writer

from acquisition.bus import Frame, WallClock, block_of
from acquisition.errors import BadInputError
from acquisition.importing import import_recording
from acquisition.recording import Block, read_recording
from acquisition.recording import content as mcap_content
from acquisition.session import Recorder, process


def test_truncation_leaves_prefix_or_one_line(whole, tmp_path):
    data, full = whole.read_bytes(), read_recording(whole)
    rng = np.random.default_rng(2)
    cuts = sorted(
        {*range(20), *range(len(data) - 20, len(data)), *rng.integers(0, len(data), 120).tolist()}
    )
    lengths = []
    for length in cuts:
        (tmp_path / "cut.mcap").write_bytes(data[:length])
        part = attempt(tmp_path / "cut.mcap")
        if isinstance(part, str):
            assert not lengths, f"readable before byte {length}, but not there: {part}"
            continue
        assert part.cut
        assert is_prefix(part, full)
        assert (part.metadata, part.attachments) == (full.metadata, full.attachments)
        lengths.append(0 if part.samples is None else len(part.samples))
    # unwritten disk space
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3] + bytes(4096))
    assert read_recording(tmp_path / "cut.mcap").cut
    assert lengths == sorted(lengths)  # a longer file never tells less
    assert set(lengths) == {0, 40, 80, 120, 160, 200, 240}  # each flush counts


def spoilt(path: Path, data: bytearray, place: int, bit: int) -> Path:
    path.write_bytes(data[:place] + bytes([data[place] ^ bit]) + data[place + 1 :])
    return path


def test_flipped_bit_is_error_or_harmless(whole, tmp_path):
    data, full = bytearray(whole.read_bytes()), read_recording(whole)
    rng, refused = np.random.default_rng(3), 0
    places = [
        *range(60),
        *range(len(data) - 60, len(data)),
        *rng.integers(0, len(data), 250).tolist(),
    ]
    for place, bit in zip(places, (1 << rng.integers(8, size=len(places))).tolist(), strict=True):
        found = attempt(spoilt(tmp_path / "bad.mcap", data, place, bit))
        refused += isinstance(found, str)
        assert isinstance(found, str) or same(found, full), f"byte {place} bit {bit}"
    assert refused > len(places) / 2


def test_flipped_bit_in_truncated_file_is_found(whole, tmp_path):
    data = bytearray(whole.read_bytes()[: -whole.stat().st_size // 3])
    full = read_recording(whole)
    start = data.index(b"robot.toml")
    for place in (data.index(b"1000.0"), start + 500):
        with pytest.raises(BadInputError, match=r"crc32|CRC"):
            read_recording(spoilt(tmp_path / "bad.mcap", data, place, 1))
    for place in range(data.index(b"zstd") + 20, len(data), 251):
        found = attempt(spoilt(tmp_path / "bad.mcap", data, place, 16))
        assert isinstance(found, str) or is_prefix(found, full), f"byte {place}"


@pytest.mark.parametrize("with_frames", [True, False])
def test_recovers_truncated_file(robot, tmp_path, with_frames):
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    write(cut, robot, with_frames=with_frames)
    data = cut.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    import_recording(cut, out)
    recovered, before = read_recording(out), read_recording(cut)
    assert not recovered.cut
    assert len(before.samples) > 0
    assert recovered.metadata["recovered_from"] == before.sha256
    if with_frames:  # without SYNC: they do not decode
        *events, reason, copied = recovered.events
        assert reason.text.startswith("no samples: ")
        assert copied.text.endswith("samples before the end are copied")
        recovered = replace(recovered, events=tuple(events))
    kept = {k: v for k, v in recovered.metadata.items() if k not in ("recovered_from", "crc32")}
    assert same(replace(recovered, metadata={**kept, "crc32": before.metadata["crc32"]}), before)


def test_decompressed_size_is_limited(tmp_path, robot, whole, monkeypatch):
    with (tmp_path / "bomb.mcap").open("wb") as file:
        writer = described(file, GOOD, robot.files)
        channel = writer.register_channel(
            "/samples", "numpy", writer.register_schema("x", "numpy", LAYOUT.encode())
        )
        writer.add_message(channel, 0, bytes(70 * 2**20), 0)
        writer.finish()
    assert (tmp_path / "bomb.mcap").stat().st_size < 20_000
    with pytest.raises(BadInputError, match=r"a chunk has 67108865 bytes, expected 67108864"):
        read_recording(tmp_path / "bomb.mcap")
    monkeypatch.setattr(mcap_content, "_MAX_TOTAL_BYTES", 10_000)
    with pytest.raises(BadInputError, match="unpack to more than 10000 bytes"):
        read_recording(whole)


def record(
    path: Path,
    metadata: dict[str, str],
    attachments: dict[str, bytes],
    messages: list[tuple[str, str, bytes]],
) -> None:
    with path.open("wb") as file:
        writer = described(file, metadata, attachments)
        for topic, layout, content in messages:
            schema = writer.register_schema("x", "numpy", layout.encode())
            writer.add_message(writer.register_channel(topic, "numpy", schema), 5, content, 5)
        writer.finish()


def described(
    file: IO[bytes], metadata: Mapping[str, str], attachments: Mapping[str, bytes]
) -> Writer:
    """The beginning of a recording that is still to get its data, in one chunk."""
    writer = Writer(file, chunk_size=2**30)
    writer.start()
    if metadata:
        crc = f"{zlib.crc32(json.dumps(sorted(metadata.items())).encode()):08x}"
        writer.add_metadata("recording", {"crc32": crc, **metadata})
    for name, content in attachments.items():
        writer.add_attachment(0, 0, name, "", content)
    return writer


LAYOUT = "[('stamp_ns', '<i8'), ('position', '<f8', (2,)), ('effort', '<f8', (2,))]"
FRAMES_LAYOUT = (
    "[('time_ns', '<i8'), ('can_id', '<u4'), ('length', '|u1'), ('flags', '|u1'), ('data', "
    "'|u1', (8,))]"
)
GOOD = {"schema_version": "1", "sample_rate_hz": "1000.0", "effort_unit": '["N m", "N m"]'}
ROW = struct.pack("<q4d", 0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("metadata", "messages", "message"),
    [
        ({}, [], "the file has no metadata record 'recording'. Import a ROS 2 bag"),
        (
            {**GOOD, "schema_version": "3"},
            [("/x", "", b"")],
            "schema_version = 3: a newer version of .*: expected at most 2",
        ),
        ({**GOOD, "schema_version": "²"}, [], "schema_version = '²': expected a whole number"),
        (
            {**GOOD, "crc32": "00000000"},
            [],
            "crc32 = '00000000': the metadata are damaged: expected",
        ),
        (
            {**GOOD, "sample_rate_hz": "nan"},
            [],
            "sample_rate_hz = 'nan': expected a positive number",
        ),
        (
            {**GOOD, "effort_unit": '["A", "A"]'},
            [],
            r'effort_unit = \["A", "A"\]: expected \["N m", "N m"\]',
        ),
        (
            GOOD,
            [("/samples", "[('a', '<f8')]", b"12345678")],
            "/samples: the rows have the layout .*: expected",
        ),
        (
            GOOD,
            [("/samples", LAYOUT, ROW[:-1])],
            "39 bytes: expected whole rows of 40 bytes",
        ),
        (
            GOOD,
            [("/samples", LAYOUT, ROW + ROW)],
            "row 2: stamp_ns = 0: expected growing timestamps",
        ),
        (
            GOOD,
            [("/samples", LAYOUT, b"\xff" * 7 + b"\x7f" + ROW[8:])],
            "row 1: stamp_ns = 9223372036854775807",
        ),
        (
            GOOD,
            [("/samples", LAYOUT, ROW), ("/samples", "[]", ROW)],
            "the layout of /samples changes",
        ),
        (
            GOOD,
            [("/can/a/frames", LAYOUT, ROW)],
            "/can/a/frames: the rows have the layout .*: expected",
        ),
        (
            GOOD,
            [("/can/a/frames", FRAMES_LAYOUT, bytes(12) + b"\x09" + bytes(9))],
            "row 1: a frame has length = 9, .* expected at most 8",
        ),
        (
            GOOD,
            [("/can/a/frames", FRAMES_LAYOUT, bytes(7) + b"\xff" + bytes(14))],
            "time_ns = -72057594037927936",
        ),
        (GOOD, [("/events", "", b'{"kind": 1}')], "/events: Expected `str`, got `int`"),
        (GOOD, [("/health", "", b'{"drops": "many"}')], r"/health: Expected `float \| null`"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path, robot, metadata, messages, message):
    record(tmp_path / "odd.mcap", metadata, dict(robot.files), messages)
    with pytest.raises(BadInputError, match=message) as caught:
        read_recording(tmp_path / "odd.mcap")
    assert str(caught.value).startswith(str(tmp_path / "odd.mcap"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda writer: writer.add_metadata("recording", GOOD),
         "it has a second metadata record 'recording': merged recordings"),
        (lambda writer: writer.add_attachment(0, 0, "robot.toml", "", b""),
         r"it has a second attachment 'robot\.toml'"),
        (lambda writer: writer.add_message(7, 0, b"", 0),
         "a message has the channel 7, which is not described"),
    ],
)  # fmt: skip
def test_duplicate_or_orphan_records_are_refused(tmp_path, robot, change, message):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = described(file, GOOD, robot.files)
        change(writer)
        writer.finish()
    with pytest.raises(BadInputError, match=message):
        read_recording(tmp_path / "a.mcap")


def test_empty_channel_is_ignored(tmp_path, robot):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = described(file, GOOD, robot.files)
        writer.register_channel(
            "/samples", "numpy", writer.register_schema("x", "numpy", LAYOUT.encode())
        )
        writer.add_message(writer.register_channel("/x", "", 0), 0, b"", 0)
        writer.finish()
    recording = read_recording(tmp_path / "a.mcap")
    assert (recording.samples, recording.frames) == (None, {})


@pytest.mark.parametrize(
    "content", [b"", b"time,q1\n0,1\n", b"\x89MCAP0\r", b"\x89HDF\r\n\x1a\n" * 50]
)
def test_invalid_mcap_is_refused(tmp_path, content):
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(BadInputError, match="is not an MCAP file"):
        read_recording(tmp_path / "a.mcap")


def test_missing_file_folder_or_robot_toml(tmp_path, robot):
    path = tmp_path / "a.mcap"
    for toml, where, message in (
        (None, tmp_path / "none.mcap", r"none\.mcap: the file cannot be read: No such file"),
        (None, tmp_path, "cannot be read: Is a directory"),
        (None, path, r"the recording has no robot.toml attached"),
        (b"name = 1", path, r"a\.mcap: robot.toml: name = 1: expected a text"),
    ):
        record(path, GOOD, {} if toml is None else {"robot.toml": toml}, [])
        with pytest.raises(BadInputError, match=message):
            read_recording(where)
    # The file that all of these and those above differ from is read.
    record(path, GOOD, dict(robot.files), [("/samples", LAYOUT, ROW), ("/elsewhere", "", b"x")])
    assert read_recording(path).samples.tobytes() == ROW


def recorded(
    path: Path, messages: list[Any], receiver: SimpleNamespace, sync_ids: list[int]
) -> Any:
    """What the recorder's process makes of frames that `take` of the receiver makes up, and of
    the session's messages.
    """
    recorder = Recorder(path, robot_of(bus_text()), source="x", place="robot.toml")
    pipe: Any = SimpleNamespace(
        poll=lambda timeout_s: bool(messages),
        recv=lambda: messages.pop(0),
        send=lambda message: None,
    )
    return process._record(pipe, recorder, receiver, np.array(sync_ids, int), None)  # type: ignore[arg-type]


def receiver_of(take: Callable[[], Block], sock: object = None) -> SimpleNamespace:
    return SimpleNamespace(take=take, sock=sock, error=None, stopped=False, run=lambda: None)


def test_rows_are_complete_after_clock_step(tmp_path, monkeypatch):
    """By half an hour before the first frame and an hour later; the recorder goes on
    with the session's clock.
    """
    before_ns, further_ns = 1_800_000_000_000, 3_600_000_000_000
    true, now, wall = flat(session(syncs=60)), [0], [before_ns]
    monkeypatch.setattr(
        process, "WallClock", partial(WallClock, lambda: now[0] + wall[0], lambda: now[0])
    )
    monkeypatch.setattr(process, "kernel_drops", lambda sock: 0)
    messages: list[Any] = [("clock", 0)]
    blocks = iter(np.split(true, [50, 100]))

    def take() -> Block:
        block = next(blocks, true[:0]).copy()
        if len(block):
            now[0] = int(block["time_ns"][-1])
        elif not receiver.stopped:
            messages.append(("stop", now[0]))
        if len(block) and now[0] >= true["time_ns"][70]:
            wall[0] = before_ns + further_ns
            block["time_ns"][block["time_ns"] >= true["time_ns"][70]] += further_ns
        block["time_ns"] += before_ns
        return block

    receiver = receiver_of(take)
    done = recorded(tmp_path / "a.mcap", messages, receiver, [0x80])
    assert (done.samples, done.warnings) == (60, ())
    recording = read_recording(tmp_path / "a.mcap")
    assert (
        recording.samples["stamp_ns"].tolist() == true["time_ns"][true["can_id"] == 0x80].tolist()
    )
    for event, by in zip(recording.events, ("1.8e+03", "3.6e+03"), strict=True):
        assert event.text == f"the clock was set forward by {by} s; recorded times ignore this step"
        assert true["time_ns"][0] < event.stamp_ns <= true["time_ns"][-1]


def test_recorder_socket_drops_are_recorded(tmp_path, monkeypatch):
    now, messages, dropping = [0], [], object()

    def take() -> Block:
        now[0] += 600_000_000  # a status each time
        if now[0] > 1_500_000_000:
            messages.append(("stop", now[0]))
        return block_of([Frame(now[0], 0x80, b"")])

    monkeypatch.setattr(process, "WallClock", partial(WallClock, lambda: now[0], lambda: now[0]))
    monkeypatch.setattr(process, "kernel_drops", lambda sock: 7 if sock is dropping else 0)
    recorded(tmp_path / "a.mcap", messages, receiver_of(take, dropping), [])
    health = read_recording(tmp_path / "a.mcap").health
    assert len(health) > 1
    assert {h.counters["kernel_drops"] for h in health} == {7}
