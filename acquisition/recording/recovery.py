"""A recording written anew: a whole one from one that was cut by a kill or a power failure, or with samples made again."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..errors import Place
from ..files import atomic_write
from .reader import Recording, read_recording
from .schema import Header
from .writer import RecordingWriter


def rewrite(
    recording: Recording, header: Header, out: Path, add: Callable[[RecordingWriter], None], *, without: str = ""
) -> None:
    """Write the frames, events (but those of the kind `without`) and health of a recording anew; `add` writes the samples."""
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        for channel, frames in recording.frames.items():
            writer.frames(channel, frames)
        for event in recording.events:
            if event.kind != without:
                writer.event(event.stamp_ns, event.kind, event.text)
        for health in recording.health:
            writer.health(health.stamp_ns, health.counters)
        add(writer)


def recover(
    cut_path: Path, out_path: Path, decode: Callable[[Recording, RecordingWriter], None] | None = None
) -> Recording:
    """Write a whole recording of everything before the cut of one without its end; returns what was read.

    `decode` writes the samples of a recording that has frames.

    An `AcquisitionError` as of `read_recording`; also if the file is not cut, or `out_path` cannot be written.
    """
    recording = read_recording(cut_path)
    if not recording.cut:
        Place(str(cut_path)).refuse(text="has its proper end: nothing to recover")

    def add(writer: RecordingWriter) -> None:
        if recording.frames and decode is not None:
            decode(recording, writer)
        elif recording.samples is not None:
            writer.samples(recording.samples)

    notes = {**recording.metadata, "recovered_from": recording.sha256}
    rewrite(recording, replace(recording.header, notes=notes), out_path, add)
    return recording
