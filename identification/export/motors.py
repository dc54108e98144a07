"""Identified drive gains in the description of a fit: keys of its [[motor]] tables."""

import msgspec
from msgspec import UNSET

from ..report import DriveGain, FitFile
from .tables import replace_in_tables


def with_gains(stored: FitFile, place: str) -> tuple[FitFile, tuple[str, ...]]:
    """The fit with its drive gains in its description, and lines on them.

    A gain that is not determined is left as described; without a described one it is written with its wide interval. Raises
    `IdentificationError` where a [[motor]] cannot be replaced line by line.
    """
    if stored.gains is UNSET or "robot.toml" not in stored.description:
        return stored, ()
    known = {gain.motor: _keys(gain) for gain in stored.gains if gain.determined or gain.described is None}
    text = replace_in_tables(stored.description["robot.toml"], "motor", known, f"the robot.toml in {place}")
    lines = list[str]()
    for gain in stored.gains:
        done = "as identified" if gain.motor in known else "as described"
        if not gain.determined:
            done += ", since none is described" * (gain.described is None) + "; not determined"
        lines.append(f"drive gain of {gain.motor} {done}: {gain.value:.4g} ± {gain.half_width:.2g} {gain.unit}")
    return msgspec.structs.replace(stored, description={**stored.description, "robot.toml": text}), tuple(lines)


def _keys(gain: DriveGain) -> dict[str, object]:
    values: dict[str, object] = {"drive_gain_unit": gain.unit, "drive_gain": gain.value}
    return {"drive_gain_half_width": gain.half_width} | values if gain.half_width > 0 else values
