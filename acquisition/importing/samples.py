"""Values at the joints on a uniform grid → a recording: the checks that all imports share, and the writing."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..arrays import Array, Ints
from ..errors import AcquisitionError
from ..files import atomic_write
from ..recording import EFFORT_MEASURED, EFFORT_TIMING, Header, RecordingWriter, sample_dtype
from ..robot import Robot, check_recorded_positions
from .time_base import TimeReport

SPEED_WINDOW_S = (
    0.05  # positions and speeds are compared over windows of this length: noise of single samples matters less
)
SPEED_OFF = 0.1  # of the change of position: speeds further off are told
WRONG_SPEED = 2.0  # a factor that only a wrong unit, sign or column explains


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
    as in the recording's header; `doubts`: warnings about the times, which are kept in the recording; `effort_measured`:
    efforts were measured at the instants of the samples, not commands that are held after them.
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
    effort_measured: bool = False


def write_samples(found: Samples, out: Path) -> Imported:
    """Check samples and write them as the recording `out`, whole or not at all.

    Raises `AcquisitionError` for positions that no robot has, or speeds that are not theirs.
    """
    robot, parts = found.robot, found.parts
    t_s = (found.stamps - found.stamps[0]) * np.float64(1e-9)
    warnings = check_recorded_positions(robot, t_s, parts["position"], found.place)
    doubts = [*found.doubts, *_effort_doubts(robot, parts["effort"])]
    if "velocity" in parts:
        doubts += _speed_doubts(found)
    rows = np.empty(len(t_s), sample_dtype(robot.n, reference="reference" in parts, optional=parts))
    rows["stamp_ns"] = found.stamps
    for name, part in parts.items():
        rows[name] = part
    times = {} if found.report is None else {"times": found.report.text}
    timing = {EFFORT_TIMING: EFFORT_MEASURED} if found.effort_measured else {}
    header = Header(
        robot=robot,
        source=found.source,
        sample_rate_hz=found.rate_hz,
        effort_provenance=found.provenance,
        notes={**times, **timing},
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


def _effort_doubts(robot: Robot, effort: Array) -> list[str]:
    """Warnings about joints whose effort is zero throughout."""
    dead = [joint.name for joint, column in zip(robot.joints, effort.T, strict=True) if not column.any()]
    return [f"the effort of {', '.join(dead)} is zero throughout"] if dead else []


def _speed_doubts(found: Samples) -> list[str]:
    """Warnings where recorded speeds are off the derivative of the position; refuses speeds of another unit or sign."""
    q, v, h = found.parts["position"], found.parts["velocity"], 1 / found.rate_hz
    travelled = np.concatenate([np.zeros((1, q.shape[1])), np.cumsum(0.5 * h * (v[1:] + v[:-1]), axis=0)])
    step = max(1, round(SPEED_WINDOW_S / h))
    by_position, by_speed = np.diff(q[::step], axis=0), np.diff(travelled[::step], axis=0)
    doubts = []
    for j, joint in enumerate(found.robot.joints):
        moved = float(by_position[:, j] @ by_position[:, j])
        if moved == 0.0:
            continue
        gain = float(by_position[:, j] @ by_speed[:, j]) / moved
        off = float(np.linalg.norm(by_speed[:, j] - by_position[:, j])) / np.sqrt(moved)
        text = f"velocity of joint {joint.name} = {gain:.3g} x the derivative of its position, {100 * off:.2g} % off it"
        if off > SPEED_OFF and not 1 / WRONG_SPEED < gain < WRONG_SPEED:
            expected = "the joint's own speed: check its unit, side, sign and column"
            raise AcquisitionError(text, place=found.place, expected=expected)
        if off > SPEED_OFF:
            doubts.append(text)
    return doubts
