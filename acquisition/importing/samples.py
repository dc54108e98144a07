"""Values at the joints on a uniform grid → a recording: the checks that all imports share, and the writing."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..files import atomic_write
from ..recording import Header, RecordingWriter, sample_dtype
from ..robot import check_recorded_positions, check_recorded_velocities
from .time_base import OnGrid


@dataclass(frozen=True, kw_only=True)
class Imported:
    """What was written: sizes, what was recorded besides position, the report of the times, warnings."""

    out: Path
    robot: str
    samples: int
    sample_rate_hz: float
    has_reference: bool
    effort_units: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    times: str = ""
    warnings: tuple[str, ...] = ()


def write_samples(header: Header, grid: OnGrid, doubts: Sequence[str], place: str, out: Path) -> Imported:
    """Check samples and write them as the recording `out`, whole or not at all.

    Parameters
    ----------
    header : the robot, where the samples come from, and what the grid says of their times.
    grid : values by the names of a sample's fields.
    doubts : warnings, which are written into the recording.
    place : the files, for errors.

    Raises `AcquisitionError` for stamps, positions or speeds that no robot has.
    """
    robot, parts, stamps = header.robot, grid.parts, grid.stamps_ns(place)
    t_s = (stamps - stamps[0]) * np.float64(1e-9)
    warnings = check_recorded_positions(robot, t_s, parts["position"], place)
    dead = [joint.name for joint, column in zip(robot.joints, parts["effort"].T, strict=True) if not column.any()]
    doubts = [*doubts, *grid.doubts, *([f"the effort of {', '.join(dead)} is zero throughout"] if dead else [])]
    if "velocity" in parts:
        doubts += check_recorded_velocities(robot, parts["position"], parts["velocity"], grid.rate_hz, place)
    rows = np.empty(len(t_s), sample_dtype(robot.n, reference="reference" in parts, optional=parts))
    rows["stamp_ns"] = stamps
    for name, part in parts.items():
        rows[name] = part
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        writer.samples(rows)
        for text in doubts:
            writer.event(int(stamps[-1]), "warning", text)
    return Imported(
        out=out,
        robot=robot.name,
        samples=len(rows),
        sample_rate_hz=grid.rate_hz,
        has_reference="reference" in parts,
        effort_units=robot.effort_units,
        optional=tuple(name for name in parts if name not in ("position", "effort", "reference")),
        times=grid.notes.get("times", ""),
        warnings=(*warnings, *doubts),
    )
