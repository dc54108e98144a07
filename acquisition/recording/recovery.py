"""A whole file of what a cut recording still holds."""

from dataclasses import replace
from pathlib import Path

from ..errors import AcquisitionError
from ..files import atomic_write
from .reader import Recording, read_recording
from .writer import RecordingWriter


def recover(cut_path: Path, out_path: Path) -> Recording:
    """Write to `out_path` a whole file of what the cut file `cut_path` still holds; return what that is.

    Raises `AcquisitionError` as `read_recording` does, when the file is not cut, and when `out_path` cannot be written.
    """
    recording = read_recording(cut_path)
    if not recording.cut:
        raise AcquisitionError("has its proper end: nothing to recover", place=str(cut_path))
    notes = {**recording.metadata, "recovered_from": recording.sha256}
    header = replace(recording.header, notes=notes)
    with atomic_write(out_path) as partial, RecordingWriter(partial, header) as writer:
        if recording.samples is not None:
            writer.samples(recording.samples)
        for channel, frames in recording.frames.items():
            writer.frames(channel, frames)
        for event in recording.events:
            writer.event(event.stamp_ns, event.kind, event.text)
        for health in recording.health:
            writer.health(health.stamp_ns, health.counters)
    return recording
