"""Values at the joints on a uniform grid → a recording: the checks that all imports share, and the writing."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..arrays import Array, Ints
from ..files import atomic_write
from ..recording import Header, RecordingWriter, sample_dtype
from ..robot import EffortTiming, Robot, check_recorded_positions, check_recorded_velocities
from .time_base import TimeReport


@dataclass(frozen=True, kw_only=True)
class Imported:
    """What an import wrote: sizes, what was recorded besides position and effort, the report of the times, doubts."""

    out: Path
    robot: str
    samples: int
    sample_rate_hz: float
    effort_units: tuple[str, ...]
    has_reference: bool
    optional: tuple[str, ...] = ()
    times: str = ""
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """What an import found, on a uniform grid.

    `parts` (N, n) by the names of a sample's fields; `stamps` (N,) ns; `place`: the files, for errors; `source`, `provenance`:
    as in the recording's header; `doubts`: warnings about the times, which are kept in the recording; `effort_timing`
    as in the recording's header.
    """

    robot: Robot
    parts: Mapping[str, Array]
    stamps: Ints
    rate_hz: float
    place: str
    source: str
    provenance: str
    report: TimeReport | None = None
    doubts: tuple[str, ...] = ()
    effort_timing: EffortTiming = "unknown"


def write_samples(found: Samples, out: Path) -> Imported:
    """Check samples and write them as the recording `out`, whole or not at all.

    Raises `AcquisitionError` for positions that no robot has, or speeds that are not theirs.
    """
    robot, parts = found.robot, found.parts
    t_s = (found.stamps - found.stamps[0]) * np.float64(1e-9)
    warnings = check_recorded_positions(robot, t_s, parts["position"], found.place)
    dead = [joint.name for joint, column in zip(robot.joints, parts["effort"].T, strict=True) if not column.any()]
    doubts = [*found.doubts, *([f"the effort of {', '.join(dead)} is zero throughout"] if dead else [])]
    if "velocity" in parts:
        doubts += check_recorded_velocities(robot, parts["position"], parts["velocity"], found.rate_hz, found.place)
    rows = np.empty(len(t_s), sample_dtype(robot.n, reference="reference" in parts, optional=parts))
    rows["stamp_ns"] = found.stamps
    for name, part in parts.items():
        rows[name] = part
    times = {} if found.report is None else {"times": found.report.text}
    header = Header(
        robot=robot,
        source=found.source,
        sample_rate_hz=found.rate_hz,
        effort_provenance=found.provenance,
        effort_timing=found.effort_timing,
        notes=times,
    )
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        writer.samples(rows)
        for text in doubts:
            writer.event(int(found.stamps[-1]), "warning", text)
    return Imported(
        out=out,
        robot=robot.name,
        samples=len(rows),
        sample_rate_hz=found.rate_hz,
        effort_units=robot.effort_units,
        has_reference="reference" in parts,
        optional=tuple(name for name in parts if name not in ("position", "effort", "reference")),
        times="" if found.report is None else found.report.text,
        warnings=(*warnings, *doubts),
    )
