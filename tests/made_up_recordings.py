"""Recordings made up for tests, and what it means that two hold the same."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from acquisition.errors import RobotIdimError
from acquisition.recording import (
    EXTENDED,
    FRAME,
    SENT,
    Block,
    Header,
    Recording,
    RecordingWriter,
    read_recording,
    sample_dtype,
)
from acquisition.robot import Robot


def some_samples(
    count: int, *, n: int = 2, reference: bool = True, rate_hz: float = 1000.0, first: int = 0
) -> Block:
    samples = np.zeros(count, sample_dtype(n, reference=reference))
    rng = np.random.default_rng(first)
    samples["stamp_ns"] = np.rint((first + np.arange(count)) * 1e9 / rate_hz)
    for field in (samples.dtype.names or ())[1:]:
        samples[field] = rng.normal(size=(count, n))
    return samples


def some_frames(count: int) -> Block:
    frames = np.zeros(count, FRAME)
    rng = np.random.default_rng(1)
    frames["time_ns"] = np.arange(count) * 1_000_000
    frames["can_id"] = rng.integers(0, 0x7FF, count)
    frames["length"] = 8
    frames["flags"] = rng.choice([0, SENT, EXTENDED | SENT], count)
    frames["data"] = rng.integers(0, 256, (count, 8))
    return frames


def header(robot: Robot, sample_rate_hz: float = 1000.0) -> Header:
    return Header(robot=robot, source="", sample_rate_hz=sample_rate_hz, effort_provenance="")


def write(
    path: Path, robot: Robot, *, blocks: int = 6, rows: int = 40, with_frames: bool = True
) -> None:
    """A small recording with something of everything, in as many chunks as there are blocks."""
    with RecordingWriter(
        path,
        Header(
            robot=robot,
            source="a test",
            sample_rate_hz=1000.0,
            effort_provenance="made up, Rᵀ",
            notes={"bitrate": "1000000"},
            attachments={"../../etc/drive.eds": b"[FileInfo]\n"},
        ),
    ) as writer:
        samples, frames = some_samples(blocks * rows), some_frames(blocks * rows)
        writer.event(0, "phase", "track")
        for k in range(0, len(samples), rows):
            writer.samples(samples[k : k + rows])
            if with_frames:
                writer.frames("can0", frames[k : k + rows])
            writer.health(k, {"kernel_drops": k, "jitter_s": 1e-5})
            writer.flush()
        writer.event(len(samples), "phase", "stop")


def written_again(
    path: Path, out: Path, more: Callable[[Writer], None] = lambda _: None, **how: Any
) -> Path:
    """The content of an MCAP file as another program writes it, and `more` before its end."""
    with path.open("rb") as file, out.open("wb") as other:
        reader, writer, channels = make_reader(file), Writer(other, **how), dict[int, int]()
        writer.start(reader.get_header().profile, "another program")
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, dict(record.metadata))
        for one in reader.iter_attachments():
            writer.add_attachment(one.create_time, one.log_time, one.name, "", one.data)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, dict(channel.metadata)
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        more(writer)
        writer.finish()
    return out


def same(a: Recording, b: Recording) -> bool:
    """Equal data; the file's digest and its end set apart."""
    return (
        is_prefix(a, b)
        and is_prefix(b, a)
        and (a.metadata, a.attachments, a.robot.name) == (b.metadata, b.attachments, b.robot.name)
    )


def is_prefix(a: Recording, b: Recording) -> bool:
    """All that `a` holds stands at the beginning of what `b` holds, byte for byte."""
    pairs = [
        (a.samples, b.samples),
        *((block, b.frames.get(name)) for name, block in a.frames.items()),
    ]
    return (
        all(x is None or (y is not None and y.tobytes().startswith(x.tobytes())) for x, y in pairs)
        and a.events == b.events[: len(a.events)]
        and a.health == b.health[: len(a.health)]
    )


def attempt(path: Path) -> Recording | str:
    """What the file holds, or the one line that says why not."""
    try:
        return read_recording(path)
    except RobotIdimError as error:
        text = str(error)
    assert "\n" not in text
    assert text.startswith(str(path))
    return text
