"""What a recording holds, on one page: for people as tables, for programs as JSON."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from . import one_line
from .blocks import SENT, Gap, gaps
from .recording import Event, Health, Recording

_SHOWN = 20  # gaps and events in the tables; the JSON has all


@dataclass(frozen=True, kw_only=True)
class JointRange:
    """Lowest and highest position and effort of a joint, in `position_unit` and `effort_unit`."""

    name: str
    position_unit: str
    position: tuple[float, float]
    effort_unit: str
    effort: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class FrameCount:
    """Frames on one CAN channel, those of them sent by us, and the seconds they span."""

    channel: str
    frames: int
    sent: int
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class Overview:
    """What `robot-acquire info` tells; plain data."""

    robot: str
    source: str
    created: str
    software: str
    cut: bool
    samples: int
    sample_rate_hz: float
    duration_s: float
    has_reference: bool
    joints: tuple[JointRange, ...]
    effort_provenance: str
    gaps: tuple[Gap, ...]
    frames: tuple[FrameCount, ...]
    events: tuple[Event, ...]
    health: Health | None
    attachments: Mapping[str, int]
    sha256: str


def overview(recording: Recording) -> Overview:
    """Sum up a recording. `health` is the last one recorded; `attachments` maps names to sizes in bytes."""
    samples, robot = recording.samples, recording.robot
    joints: list[JointRange] = []
    if samples is not None:
        q, effort = samples["position"], samples["effort"]
        for i, joint in enumerate(robot.joints):
            joints.append(
                JointRange(
                    name=joint.name,
                    position_unit=joint.position_unit,
                    position=(float(q[:, i].min()), float(q[:, i].max())),
                    effort_unit=robot.effort_units[i],
                    effort=(float(effort[:, i].min()), float(effort[:, i].max())),
                )
            )
    return Overview(
        robot=robot.name,
        source=recording.metadata.get("source", ""),
        created=recording.metadata.get("created", ""),
        software=recording.metadata.get("software", ""),
        cut=recording.cut,
        samples=0 if samples is None else len(samples),
        sample_rate_hz=recording.sample_rate_hz,
        duration_s=0.0 if samples is None else int(samples["stamp_ns"][-1] - samples["stamp_ns"][0]) * 1e-9,
        has_reference=samples is not None and "reference" in (samples.dtype.names or ()),
        joints=tuple(joints),
        effort_provenance=recording.metadata.get("effort_provenance", ""),
        gaps=() if samples is None else gaps(samples, recording.sample_rate_hz),
        frames=tuple(
            FrameCount(
                channel=channel,
                frames=len(block),
                sent=int(np.count_nonzero(block["flags"] & SENT)),
                duration_s=float(np.ptp(block["time_ns"]) * 1e-9),
            )
            for channel, block in recording.frames.items()
        ),
        events=recording.events,
        health=recording.health[-1] if recording.health else None,
        attachments={name: len(content) for name, content in recording.attachments.items()},
        sha256=recording.sha256,
    )


def as_tables(found: Overview) -> Group:
    """The overview for a terminal. Texts from the file are shown as plain text, without control characters."""
    facts = _table()
    for name, value in _facts(found):
        facts.add_row(Text(name, style="bold"), _plain(value))
    parts: list[Table] = [facts]
    if found.joints:
        joints = _table("joint", "position", "", "unit", "effort", "", "unit")
        for j in found.joints:
            low_high = [f"{value:.5g}" for value in (*j.position, *j.effort)]
            joints.add_row(_plain(j.name), *low_high[:2], j.position_unit, *low_high[2:], j.effort_unit)
        parts.append(joints)
    if found.gaps:
        holes = _table("gap after row", "at", "samples missing")
        for gap in found.gaps[:_SHOWN]:
            holes.add_row(str(gap.row + 1), f"{gap.stamp_ns * 1e-9:.6f} s", str(gap.missing))
        parts.append(holes)
    if found.events:
        events = _table("event", "at", "")
        for event in found.events[:_SHOWN]:
            events.add_row(_plain(event.kind), f"{event.stamp_ns * 1e-9:.6f} s", _plain(event.text))
        parts.append(events)
    return Group(*parts)


def _facts(found: Overview) -> Iterator[tuple[str, str]]:
    yield "robot", found.robot
    yield "source", found.source
    yield "created", f"{found.created} by {found.software}"
    yield "end", "missing: this is what stands before the cut" if found.cut else "whole"
    if found.samples:
        reference = "with reference" if found.has_reference else "without reference"
        yield "samples", f"{found.samples} at {found.sample_rate_hz:g} Hz, {found.duration_s:g} s, {reference}"
        missing = sum(gap.missing for gap in found.gaps)
        yield "gaps", f"{len(found.gaps)}, {missing} samples missing" if found.gaps else "none"
    yield "effort", found.effort_provenance
    for count in found.frames:
        yield f"CAN {count.channel}", f"{count.frames} frames, {count.sent} of them sent, {count.duration_s:g} s"
    if found.events:
        yield "events", str(len(found.events))
    if found.health is not None:
        yield "health", ", ".join(f"{name} {value:g}" for name, value in found.health.counters.items())
    yield "attached", ", ".join(f"{name} ({size} bytes)" for name, size in found.attachments.items())
    yield "sha256", found.sha256


def _table(*columns: str) -> Table:
    return Table(*columns, box=box.SIMPLE_HEAD if columns else None, show_header=bool(columns))


def _plain(text: str) -> Text:
    """Text of the file as it stands: no markup, and nothing that moves a terminal's cursor."""
    return Text(one_line(text))
