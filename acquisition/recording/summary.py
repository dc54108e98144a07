"""What a recording holds, on one page: for people as tables, for programs as JSON."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from ..arrays import Ints
from ..errors import one_line
from ..robot import extra_columns
from .reader import Event, Health, Recording
from .rows import SENT, Block, Gap, gaps, in_parts

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
class ExtraRange:
    """Lowest and highest value of an extra object of a motor's drive; an empty `unit` is that of raw integers."""

    motor: str
    name: str
    unit: str
    value: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class FrameCount:
    """Frames on one CAN channel, those of them sent by us, and the seconds they span."""

    channel: str
    frames: int
    sent: int
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class Overview:
    """The content of `robot-acquire info` as plain data. Stamps are the recording's; tables count them from `first_ns`.

    `step_jitter_s` is the standard deviation and the worst deviation of the steps between samples, gaps left out.
    `times` is what the times of an imported recording's rows were like before they were put on a uniform grid.
    `first_ns` is the stamp of the first sample, of the first frame where there are no samples, None without either.
    `no_samples` is why there are none; `row_doubts` what the frames say of samples that an older version made of them.
    """

    robot: str
    source: str
    created: str
    software: str
    cut: bool
    samples: int
    sample_rate_hz: float
    duration_s: float
    first_ns: int | None
    has_reference: bool
    joints: tuple[JointRange, ...]
    extras: tuple[ExtraRange, ...]
    step_jitter_s: tuple[float, float]
    no_samples: str
    row_doubts: str
    effort_provenance: str
    times: str
    gaps: tuple[Gap, ...]
    frames: tuple[FrameCount, ...]
    events: tuple[Event, ...]
    health: Health | None
    attachments: Mapping[str, int]
    sha256: str


def overview(recording: Recording, row_doubts: str = "") -> Overview:
    """Sum up a recording. `health` is the last one recorded; `attachments` maps names to sizes in bytes."""
    samples, robot = recording.samples, recording.robot
    joints: list[JointRange] = []
    spans = {channel: _ranges(block, "time_ns") for channel, block in recording.frames.items() if len(block)}
    firsts = [int(span[0][0]) for span in spans.values()]
    if samples is not None:
        firsts = [int(samples["stamp_ns"][0])]
        q, effort = _ranges(samples, "position"), _ranges(samples, "effort")
        for i, joint in enumerate(robot.joints):
            joints.append(
                JointRange(
                    name=joint.name,
                    position_unit=joint.position_unit,
                    position=q[i],
                    effort_unit=robot.effort_units[i],
                    effort=effort[i],
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
        first_ns=min(firsts, default=None),
        has_reference=samples is not None and "reference" in (samples.dtype.names or ()),
        joints=tuple(joints),
        extras=_extras(recording),
        step_jitter_s=(0.0, 0.0) if samples is None else _step_jitter(samples["stamp_ns"]),
        no_samples=recording.no_samples if samples is None else "",
        row_doubts=row_doubts,
        effort_provenance=recording.metadata.get("effort_provenance", ""),
        times=recording.metadata.get("times", ""),
        gaps=() if samples is None else gaps(samples, recording.sample_rate_hz, _own_syncs(recording)),
        frames=tuple(
            FrameCount(
                channel=channel,
                frames=len(block),
                sent=sum(int(np.count_nonzero(part["flags"] & SENT)) for part in in_parts(block)),
                duration_s=float(np.ptp(spans[channel]) * 1e-9) if len(block) else 0.0,
            )
            for channel, block in recording.frames.items()
        ),
        events=recording.events,
        health=recording.health[-1] if recording.health else None,
        attachments={name: len(content) for name, content in recording.attachments.items()},
        sha256=recording.sha256,
    )


def _extras(recording: Recording) -> tuple[ExtraRange, ...]:
    samples = recording.samples
    if samples is None or "extra" not in (samples.dtype.names or ()):
        return ()
    return tuple(
        ExtraRange(motor=c.motor, name=c.name, unit=c.unit, value=value)
        for c, value in zip(extra_columns(recording.robot), _ranges(samples, "extra"), strict=True)
    )


def _ranges(rows: Block, field: str) -> list[tuple[float, float]]:
    """Lowest and highest value of each column of a field."""
    ends = [(part[field].min(axis=0), part[field].max(axis=0)) for part in in_parts(rows)]
    lows, highs = (np.array(end).reshape(len(ends), -1) for end in zip(*ends, strict=True))
    return list(zip(lows.min(axis=0).tolist(), highs.max(axis=0).tolist(), strict=True))


def _own_syncs(recording: Recording) -> Ints | None:
    """Times of the SYNCs that we sent; None where there are none."""
    bus = recording.robot.bus
    found = [
        part["time_ns"][(part["can_id"] == bus.sync_can_id) & ((part["flags"] & SENT) != 0)]
        for block in recording.frames.values()
        for part in in_parts(block)
        if bus is not None
    ]
    times = np.concatenate(found) if found else np.zeros(0, np.int64)
    return np.sort(times) if len(times) else None


def _step_jitter(stamps: Ints) -> tuple[float, float]:
    """Standard deviation and worst deviation of the steps between samples from the usual one, gaps left out; s."""
    steps = np.diff(stamps).astype(np.float64)
    if not len(steps):
        return 0.0, 0.0
    off = steps - np.median(steps)
    off = off[np.abs(off) <= 0.5 * np.median(steps)]
    return float(np.sqrt(np.mean(off**2))) * 1e-9, float(np.abs(off).max()) * 1e-9


def as_tables(found: Overview) -> Group:
    """The overview for a terminal. Texts from the file are shown as plain text, without control characters."""
    facts = _table()
    for name, value in _facts(found):
        facts.add_row(Text(name, style="bold"), _plain(value))
    parts = [facts]
    if found.joints:
        joints = _table("joint", "position", "", "unit", "effort", "", "unit")
        for j in found.joints:
            low_high = [f"{value:.5g}" for value in (*j.position, *j.effort)]
            joints.add_row(_plain(j.name), *low_high[:2], j.position_unit, *low_high[2:], j.effort_unit)
        parts.append(joints)
    if found.extras:
        extras = _table("motor", "object", "value", "", "unit")
        for e in found.extras:
            extras.add_row(_plain(e.motor), _plain(e.name), *(f"{v:.5g}" for v in e.value), _plain(e.unit))
        parts.append(extras)
    since = "at, s" if found.first_ns is None else f"s from the first {'sample' if found.samples else 'frame'}"
    if found.gaps:
        holes = _table("gap after row", since, "samples missing")
        for gap in found.gaps[:_SHOWN]:
            missing = f"none: SYNC {gap.missing} periods late" if gap.late else str(gap.missing)
            holes.add_row(str(gap.row + 1), _seconds(gap.stamp_ns, found), missing)
        parts.append(holes)
    if found.events:
        events = _table("event", since, "")
        for event in found.events[:_SHOWN]:
            events.add_row(_plain(event.kind), _seconds(event.stamp_ns, found), _plain(event.text))
        parts.append(events)
    return Group(*(part for table in parts for part in (_Trimmed(table), Text())))


def _seconds(stamp_ns: int, found: Overview) -> str:
    return f"{(stamp_ns - (found.first_ns or 0)) * 1e-9:.6f}"


@dataclass(frozen=True)
class _Trimmed:
    """A table whose lines end where their text does: one long line would pad all others to its length."""

    table: Table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for line in console.render_lines(self.table, options, pad=False):
            while line and not line[-1].text.strip():
                line.pop()
            yield from line[:-1]
            if line:
                yield Segment(line[-1].text.rstrip(), line[-1].style)
            yield Segment.line()


def _facts(found: Overview) -> Iterator[tuple[str, str]]:
    yield "robot", found.robot
    yield "source", found.source
    yield "created", f"{found.created} by {found.software}"
    yield "end", "missing: this is what was written before the cut" if found.cut else "whole"
    if found.samples:
        reference = "with reference" if found.has_reference else "without reference"
        yield "samples", f"{found.samples} at {found.sample_rate_hz:g} Hz, {found.duration_s:g} s, {reference}"
        missing = sum(gap.missing for gap in found.gaps if not gap.late)
        late = sum(gap.late for gap in found.gaps)
        yield "gaps", f"{len(found.gaps)}, {missing} samples missing, {late} SYNC late" if found.gaps else "none"
        sd, worst = (1e3 * value for value in found.step_jitter_s)
        yield "steps", f"jitter sd {sd:.4f} ms, worst {worst:.4f} ms, gaps left out"
    else:
        yield "samples", found.no_samples
    if found.row_doubts:
        yield "rows", found.row_doubts
    if found.times:
        yield "times", found.times
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
    table = Table(box=None, show_header=bool(columns))
    for column in columns or ("", ""):
        table.add_column(column, overflow="fold")  # a hash or a name is broken before it is cut short
    return table


def _plain(text: str) -> Text:
    """Text of the file without markup and without control characters."""
    return Text(one_line(text))
