"""The recording: what is written is read, and viewers find what they know."""

import hashlib
import json
import struct
from contextlib import suppress
from dataclasses import replace

import mcap.reader
import numpy as np
import pytest
from made_up_recordings import header, some_frames, some_samples, write
from rosbags.typesys import Stores, get_typestore

from acquisition.errors import BadInputError
from acquisition.recording import (
    EXTENDED,
    FRAME,
    SENT,
    RecordingWriter,
    gaps,
    read_recording,
    sample_dtype,
)
from acquisition.robot import robot_from_files

STORE = get_typestore(Stores.ROS2_JAZZY)


def messages_of(path, *topics: str) -> list:
    with path.open("rb") as file:
        return list(mcap.reader.make_reader(file).iter_messages(topics=topics or None))


def test_reads_written_data(whole, robot):
    recording = read_recording(whole)
    assert recording.samples.tobytes() == some_samples(240).tobytes()
    assert recording.samples.dtype == sample_dtype(2, reference=True)
    assert not recording.samples.flags.writeable
    assert list(recording.frames) == ["can0"]
    assert recording.frames["can0"].tobytes() == some_frames(240).tobytes()
    assert [(e.stamp_ns, e.kind, e.text) for e in recording.events] == [
        (0, "phase", "track"),
        (240, "phase", "stop"),
    ]
    assert [h.counters["kernel_drops"] for h in recording.health] == [0, 40, 80, 120, 160, 200]
    assert recording.attachments == {"../../etc/drive.eds": b"[FileInfo]\n", **robot.files}
    assert recording.metadata["effort_provenance"] == "made up, Rᵀ"
    assert (recording.robot.name, recording.sample_rate_hz, recording.cut) == (
        "SCARA",
        1000.0,
        False,
    )


def test_large_block_is_stored_in_small_blocks(tmp_path, robot):
    samples, path = some_samples(9001, reference=False), tmp_path / "a.mcap"
    with RecordingWriter(path, header(robot)) as writer:
        writer.samples(samples)
        writer.frames("can0", some_frames(301))
    assert read_recording(path).samples.tobytes() == samples.tobytes()
    found, row = [(c.topic, len(m.data)) for _, c, m in messages_of(path)], samples.dtype.itemsize
    assert [size // row for topic, size in found if topic == "/samples"] == [
        2000,
        2000,
        2000,
        2000,
        1001,
    ]
    # of 100 ms
    assert [size // 22 for topic, size in found if topic == "/can/can0/frames"] == [
        100,
        100,
        100,
        1,
    ]


def test_block_bytes(tmp_path, robot):
    """What a reader without numpy finds: layouts in words, rows packed
    little-endian, text in JSON.
    """
    samples = np.zeros(2, sample_dtype(2, reference=True))
    samples["stamp_ns"], samples["position"] = [7, 1_000_000_008], [[0.5, -1.5], [2.5, 3.0]]
    samples["effort"], samples["reference"] = (
        [[10.0, -20.0], [30.0, 40.0]],
        [[0.25, -0.75], [4.0, 5.0]],
    )
    frames = np.zeros(1, FRAME)
    frames[0] = (12, 0x185, 3, SENT | EXTENDED, [0x37, 0x12, 0xFB, 0, 0, 0, 0, 0])
    with RecordingWriter(tmp_path / "a.mcap", header(robot)) as writer:
        writer.samples(samples)
        writer.frames("can0", frames)
        writer.event(13, "phase", "track")
        writer.health(14, {"late": 2})
    messages = messages_of(tmp_path / "a.mcap")
    found = {
        c.topic: (s.encoding, s.data.decode(), c.message_encoding, m) for s, c, m in messages if s
    }
    encoding, layout, kind, message = found["/samples"]
    row = (
        "('stamp_ns', '<i8'), ('position', '<f8', (2,)), ('effort', '<f8', (2,)), "
        "('reference', '<f8', (2,))"
    )
    assert (encoding, layout, kind, message.log_time) == ("numpy", f"[{row}]", "numpy", 7)
    assert list(struct.iter_unpack("<q6d", message.data)) == [
        (7, 0.5, -1.5, 10.0, -20.0, 0.25, -0.75),
        (1_000_000_008, 2.5, 3.0, 30.0, 40.0, 4.0, 5.0),
    ]
    encoding, layout, kind, message = found["/can/can0/frames"]
    row = (
        "('time_ns', '<i8'), ('can_id', '<u4'), ('length', '|u1'), ('flags', '|u1'), ('data', "
        "'|u1', (8,))"
    )
    assert (encoding, layout, kind, message.log_time) == ("numpy", f"[{row}]", "numpy", 12)
    assert struct.unpack("<qIBB8s", message.data) == (
        12,
        0x185,
        3,
        3,
        bytes.fromhex("3712FB0000000000"),
    )
    assert json.loads(found["/events"][3].data) == {"kind": "phase", "text": "track"}
    assert json.loads(found["/health"][3].data) == {"late": 2}
    assert (found["/events"][3].log_time, found["/health"][3].log_time) == (13, 14)
    assert found["/events"][:3:2] == ("jsonschema", "json")


def test_recording_metadata(tmp_path, robot):
    notes = {"bitrate": "500000", "robot": "not mine to say", "schema_version": "9"}
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, replace(header(robot, 250.0), source="a test", notes=notes)):
        pass
    recording = read_recording(path)
    said = {
        "schema_version": "2", "source": "a test", "sample_rate_hz": "250.0", "robot": "SCARA",
        "joints": '["shoulder", "elbow"]', "position_unit": '["rad", "rad"]',
        "effort_unit": '["N m", "N m"]',
        "effort_provenance": "", "effort_timing": "not known", "bitrate": "500000",
    }  # fmt: skip
    assert {key: recording.metadata[key] for key in said} == said
    assert set(recording.metadata) - set(said) == {"created", "software", "crc32"}
    assert (recording.samples, recording.frames, recording.events, recording.health) == (
        None,
        {},
        (),
        (),
    )
    assert recording.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


GROWING, FINITE = "growing timestamps, 0 to 2147483647999999999", "a finite number"


@pytest.mark.parametrize(
    ("field", "values", "row", "value", "expected"),
    [
        ("stamp_ns", [5, 5, 6], 2, 5, GROWING),
        ("stamp_ns", [0, 1, 2**31 * 10**9], 3, 2**31 * 10**9, GROWING),
        ("position", [[0, 0], [0, 0], [0, np.nan]], 3, np.nan, FINITE),
        ("effort", [[0, 0], [0, np.inf], [0, 0]], 2, np.inf, FINITE),
    ],
)
def test_refused_values(tmp_path, robot, field, values, row, value, expected):
    samples = some_samples(3)
    samples[field] = values
    with (
        pytest.raises(BadInputError) as caught,
        RecordingWriter(tmp_path / "a.mcap", header(robot)) as writer,
    ):
        writer.samples(samples)
    error, key = caught.value, field if field == "stamp_ns" else f"{field} of joint 2"
    assert (error.place, error.key) == (f"{tmp_path / 'a.mcap'}: /samples: row {row}", key)
    assert (str(error.value), error.expected) == (str(value), expected)


def test_refused_row_number_counts_all_blocks(tmp_path, robot, monkeypatch):
    monkeypatch.setattr("acquisition.recording.rows._AT_ONCE", 700)
    samples = some_samples(2000)
    samples["stamp_ns"][-1] = 2**31 * 10**9 - 1
    with RecordingWriter(tmp_path / "a.mcap", header(robot)) as writer:
        writer.samples(samples)
    samples["effort"][1500, 0] = np.nan
    for row in (1501, 1401):
        again, told = (
            RecordingWriter(tmp_path / "b.mcap", header(robot)),
            pytest.raises(BadInputError, match=f"row {row}"),
        )
        with told, again as writer:
            writer.samples(samples)
        samples["stamp_ns"][1400] = samples["stamp_ns"][1399]  # the first of a block


def test_gaps_from_one_and_a_half_periods():
    samples = np.zeros(5, sample_dtype(1, reference=False))
    samples["stamp_ns"] = np.cumsum([0, 2_000_000, 2_999_990, 3_000_010, 8_000_000])
    found = [(g.row, g.stamp_ns, g.missing) for g in gaps(samples, 500.0)]
    assert found == [(2, 4_999_990, 1), (3, 8_000_000, 3)]
    assert gaps(samples[:1], 500.0) == ()


def test_other_readers_find_metadata_and_files(whole):
    with whole.open("rb") as file:
        reader = mcap.reader.make_reader(file, validate_crcs=True)
        assert [m.name for m in reader.iter_metadata()] == ["recording"]
        attached = {(a.name, a.log_time, a.create_time) for a in reader.iter_attachments()}
        # no clock: the same bytes each time
        assert attached == {("../../etc/drive.eds", 0, 0), ("robot.toml", 0, 0)}
        summary = reader.get_summary()
    topics = {channel.topic for channel in summary.channels.values()}
    joint_states = {"/joint_states/measured", "/joint_states/reference"}
    assert topics == {"/samples", "/can/can0/frames", "/events", "/health"} | joint_states


@pytest.mark.parametrize(("rate_hz", "step"), [(100.0, 1), (250.0, 3), (1024.0, 11)])
def test_joint_states_are_cdr_at_most_100_hz(tmp_path, robot, rate_hz, step):
    samples = some_samples(200, rate_hz=rate_hz)
    with RecordingWriter(tmp_path / "a.mcap", header(robot, rate_hz)) as writer:
        for k in range(0, 200, 7):  # decimation goes on across blocks
            writer.samples(samples[k : k + 7])
    for topic, field in (
        ("/joint_states/measured", "position"),
        ("/joint_states/reference", "reference"),
    ):
        found = messages_of(tmp_path / "a.mcap", topic)
        assert np.diff([m.log_time for _, _, m in found]).min() >= 10_000_000 - 1
        for (schema, channel, message), row in zip(found, samples[::step], strict=True):
            assert (schema.name, schema.encoding) == ("sensor_msgs/msg/JointState", "ros2msg")
            assert channel.message_encoding == "cdr"
            state = STORE.deserialize_cdr(message.data, schema.name)
            assert state.name == ["shoulder", "elbow"]
            assert state.position.tolist() == row[field].tolist()
            assert state.effort.tolist() == (row["effort"].tolist() if field == "position" else [])
            assert (
                state.header.stamp.sec * 10**9 + state.header.stamp.nanosec
                == row["stamp_ns"]
                == message.log_time
            )


def test_amperes_are_no_joint_state_effort(tmp_path, robot):
    toml = robot.files["robot.toml"].replace(b'effort_unit = "N m"', b'effort_unit = "A"')
    write(tmp_path / "a.mcap", robot_from_files({"robot.toml": toml}, "amperes"), blocks=1)
    messages = messages_of(tmp_path / "a.mcap", "/joint_states/measured")
    assert messages
    assert all(
        STORE.deserialize_cdr(m.data, "sensor_msgs/msg/JointState").effort.size == 0
        for _, _, m in messages
    )
    assert json.loads(read_recording(tmp_path / "a.mcap").metadata["effort_unit"]) == ["A", "A"]


def test_writer_refuses_what_reader_refuses(tmp_path, robot):
    with RecordingWriter(tmp_path / "a.mcap", header(robot)) as writer:
        writer.samples(some_samples(10))
        for bad, message in (
            (lambda: writer.samples(some_samples(10)), "row 1: stamp_ns = 0: expected growing"),
            (
                lambda: writer.samples(some_samples(10, n=3, first=10)),
                "expected sample_dtype of 2 joints",
            ),
            (
                lambda: writer.samples(some_samples(10, first=10, reference=False)),
                "as in the block before",
            ),
            (
                lambda: writer.frames("../x", some_frames(1)),
                r"CAN channel '\.\./x' has an invalid name: expected letters",
            ),
            (lambda: writer.frames("can0", some_samples(1)), "can0/frames: the rows have the type"),
            (lambda: writer.event(-1, "phase", "track"), "stamp_ns = -1"),
        ):
            with pytest.raises(BadInputError, match=message):
                bad()
        writer.samples(some_samples(0, first=10))
        writer.samples(some_samples(10, first=10))
    assert len(read_recording(tmp_path / "a.mcap").samples) == 20


def test_file_is_complete_after_failed_session(tmp_path, robot):
    path = tmp_path / "a.mcap"
    with suppress(RuntimeError), RecordingWriter(path, header(robot)) as writer:
        writer.samples(some_samples(10))
        writer.health(3, {"drops": float("nan"), "late": 2})
        raise RuntimeError("a drive reports a fault")
    recording = read_recording(path)
    assert not recording.cut
    assert len(recording.samples) == 10
    (health,) = recording.health
    assert np.isnan(health.counters["drops"])
    assert health.counters["late"] == 2
