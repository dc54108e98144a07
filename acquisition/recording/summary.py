"""Overview of a recording: tables for people, JSON for programs."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Column, Table
from rich.text import Text

from ..arrays import Ints
from ..errors import one_line
from .measured import measured_rows
from .reader import Recording
from .rows import SENT, Block, gaps, in_parts

_SHOWN = 20  # gaps and events in the tables; the JSON has all


def overview(recording: Recording) -> dict[str, Any]:
    """Collect the content of `robot-acquire info` as plain data.

    `joints` has lowest and highest values. `step_jitter_s` is the standard and the largest
    deviation of the steps between samples without gaps. `first_ns` is the time of the first sample,
    or of the first frame, or None; tables count timestamps from it. `health` has the last counters,
    `attachments` the sizes in bytes by name.
    """
    samples, robot, metadata = recording.samples, recording.robot, recording.metadata
    spans = {
        channel: _ranges(block, "time_ns")[0]
        for channel, block in recording.frames.items()
        if len(block)
    }
    joints: list[dict[str, Any]] = (
        []
        if samples is None
        else [
            {
                "name": joint.name,
                "position_unit": joint.position_unit,
                "position": position,
                "effort_unit": effort_unit,
                "effort": effort,
            }
            for joint, position, effort_unit, effort in zip(
                robot.joints,
                _ranges(samples, "position"),
                robot.effort_units,
                _ranges(samples, "effort"),
                strict=True,
            )
        ]
    )
    first_ns = (
        min((int(first) for first, _ in spans.values()), default=None)
        if samples is None
        else int(samples["stamp_ns"][0])
    )
    return {
        "robot": robot.name,
        **{key: metadata.get(key, "") for key in ("source", "created", "software")},
        "cut": recording.cut,
        "samples": 0 if samples is None else len(samples),
        "sample_rate_hz": recording.sample_rate_hz,
        "duration_s": 0.0
        if samples is None
        else int(samples["stamp_ns"][-1] - samples["stamp_ns"][0]) * 1e-9,
        "first_ns": first_ns,
        "has_reference": samples is not None and "reference" in (samples.dtype.names or ()),
        "joints": joints,
        "step_jitter_s": (0.0, 0.0) if samples is None else _step_jitter(samples["stamp_ns"]),
        "rows": "" if samples is None or len(samples) < 2 else measured_rows(samples, robot)[1],
        "no_samples": recording.no_samples if samples is None else "",
        **{key: metadata.get(key, "") for key in ("effort_provenance", "times")},
        "payload": recording.payload,
        "payload_text": recording.payload and recording.payload.describe(robot.joints[-1].name),
        "gaps": ()
        if samples is None
        else gaps(samples, recording.sample_rate_hz, _own_syncs(recording)),
        "frames": [
            {
                "channel": channel,
                "frames": len(block),
                "sent": sum(
                    int(np.count_nonzero(part["flags"] & SENT)) for part in in_parts(block)
                ),
                "duration_s": float(np.ptp(spans[channel]) * 1e-9) if len(block) else 0.0,
            }
            for channel, block in recording.frames.items()
        ],
        "events": recording.events,
        "health": recording.health[-1] if recording.health else None,
        "attachments": {name: len(content) for name, content in recording.attachments.items()},
        "sha256": recording.sha256,
    }


def _ranges(rows: Block, field: str) -> list[tuple[float, float]]:
    """Compute lowest and highest value of each column of a field."""
    ends = [(part[field].min(axis=0), part[field].max(axis=0)) for part in in_parts(rows)]
    lows, highs = (np.array(end).reshape(len(ends), -1) for end in zip(*ends, strict=True))
    return list(zip(lows.min(axis=0).tolist(), highs.max(axis=0).tolist(), strict=True))


def _own_syncs(recording: Recording) -> Ints | None:
    """Return the times of the SYNCs that this master sent; None without any."""
    bus = recording.robot.bus
    found = [
        part["time_ns"][(part["can_id"] == bus.sync_can_id) & ((part["flags"] & SENT) != 0)]
        for block in recording.frames.values()
        for part in in_parts(block)
        if bus is not None
    ]
    return np.sort(np.concatenate(found)) if any(map(len, found)) else None


def _step_jitter(stamps: Ints) -> tuple[float, float]:
    """Compute the standard and largest deviation of steps between samples from their median.

    They are in s. Gaps are left out.
    """
    steps = np.diff(stamps).astype(np.float64)
    if not len(steps):
        return 0.0, 0.0
    deviation = steps - np.median(steps)
    deviation = deviation[np.abs(deviation) <= 0.5 * np.median(steps)]
    return float(np.sqrt(np.mean(deviation**2))) * 1e-9, float(np.abs(deviation).max()) * 1e-9


def as_tables(found: Mapping[str, Any]) -> Group:
    """Format the overview for a terminal.

    Texts from the file are shown as plain text, without control characters.
    """
    first = "sample" if found["samples"] else "frame"
    since = "at, s" if found["first_ns"] is None else f"s from the first {first}"
    tables = [
        _table(
            ("", ""), [(Text(name, style="bold"), value) for name, value in _facts(found).items()]
        ),
        _table(
            ("joint", "position", "", "unit", "effort", "", "unit"),
            [
                (j["name"], *j["position"], j["position_unit"], *j["effort"], j["effort_unit"])
                for j in found["joints"]
            ],
        ),
        _table(
            ("gap after row", since, "samples missing"),
            [
                (
                    str(gap.row + 1),
                    _seconds(gap.stamp_ns, found),
                    f"none: SYNC {gap.missing} periods late" if gap.late else str(gap.missing),
                )
                for gap in found["gaps"][:_SHOWN]
            ],
        ),
        _table(
            ("event", since, ""),
            [
                (event.kind, _seconds(event.stamp_ns, found), event.text)
                for k, event in enumerate(found["events"])
                if k < _SHOWN or event.kind == "operator"
            ],
        ),
    ]
    return Group(*(part for table in tables if table.row_count for part in (table, Text())))


def _seconds(stamp_ns: int, found: Mapping[str, Any]) -> str:
    return f"{(stamp_ns - (found['first_ns'] or 0)) * 1e-9:.6f}"


def _facts(found: Mapping[str, Any]) -> dict[str, str]:
    missing = sum(gap.missing for gap in found["gaps"] if not gap.late)
    late = sum(gap.late for gap in found["gaps"])
    sd, largest = (1e3 * value for value in found["step_jitter_s"])
    of_samples = {
        "samples": f"{found['samples']} at {found['sample_rate_hz']:g} Hz, "
        f"{found['duration_s']:g} s, {'with' if found['has_reference'] else 'without'} reference",
        "gaps": f"{len(found['gaps'])}, {missing} samples missing, {late} SYNC late"
        if found["gaps"]
        else "none",
        "steps": f"jitter sd {sd:.4f} ms, largest {largest:.4f} ms, without gaps",
    }
    optional = {
        **{
            key.partition("_")[0]: found[key]
            for key in ("times", "rows", "effort_provenance", "payload_text")
        },
        **{
            f"CAN {count['channel']}": f"{count['frames']} frames, {count['sent']} of them sent, "
            f"{count['duration_s']:g} s"
            for count in found["frames"]
        },
        "events": found["events"] and str(len(found["events"])),
        "health": found["health"]
        and ", ".join(f"{name} {value:g}" for name, value in found["health"].counters.items()),
    }
    return {
        "robot": found["robot"],
        "source": found["source"],
        "created": f"{found['created']} by {found['software']}",
        "end": "truncated: only what was written before" if found["cut"] else "complete",
        **(of_samples if found["samples"] else {"samples": found["no_samples"]}),
        **{name: text for name, text in optional.items() if text},
        "attached": ", ".join(
            f"{name} ({size} bytes)" for name, size in found["attachments"].items()
        ),
        "sha256": found["sha256"],
    }


def _table(columns: Sequence[str], rows: Sequence[Sequence[Text | str | float]]) -> Table:
    """Make a table: texts without markup and control characters, numbers in five digits."""
    table = Table(
        # Long hashes and names are folded to the next line.
        *(Column(column, overflow="fold") for column in columns),
        box=None,
        show_header=any(columns),
    )
    for row in rows:
        cells = (f"{cell:.5g}" if isinstance(cell, float) else cell for cell in row)
        table.add_row(*(Text(one_line(cell)) if isinstance(cell, str) else cell for cell in cells))
    return table
