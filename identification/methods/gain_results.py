"""Results of drive gains and payloads in a fit, apart from the base parameters."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acquisition.robot import Payload

from ..arrays import Array, Bools
from ..model import LINK
from ..report import DriveGain, Number, Row, Section, Table, columns

MASS, MOMENTS = LINK.index("M"), [LINK.index(name) for name in ("MX", "MY", "MZ")]


@dataclass(frozen=True, kw_only=True, eq=False)
class EstimatedPayload:
    """What a recording's robot carried, in the frame of the last joint.

    Attributes:
        recording: the first one with it; `payload`: as stated.
        values, half: (10,) XX XY XZ YY YZ ZZ MX MY MZ M of the nearest body of positive
            density, and half-widths.
        from_prior: (10,) whether a value is not from the recordings.
        near: whether there is such a body; without one the values are what is stated, or a ball's.
    """

    recording: str
    payload: Payload
    values: Array
    half: Array
    from_prior: Bools
    near: bool

    @property
    def center_of_mass_m(self) -> tuple[Array, Array]:
        """Centre of mass (3,) and half-widths (3,), which include that of the mass."""
        m, moments = self.values[MASS], self.values[MOMENTS]
        return moments / m, np.hypot(self.half[MOMENTS] / m, moments / m**2 * self.half[MASS])


def gain_sections(gains: Sequence[DriveGain], cragg_donald: float | None) -> list[Section]:
    """Identified drive gains beside those of the description, and how well they are told apart from
    the arm: the smallest eigenvalue of the statistic of Cragg and Donald.
    """
    if not gains:
        return []
    table = Table(
        columns=columns("motor", numbers=("described", "identified", "±95%", "in %"))
        + columns("unit", ""),
        rows=tuple(
            (
                one.motor,
                Number(one.described, ".4g"),
                Number(one.value, ".4g"),
                Number(one.half_width, ".2g"),
                Number(
                    100 * one.half_width / abs(one.value) if one.value else math.inf,
                    ".2f",
                    most=1000,
                ),
                one.unit,
                "" if one.determined else "not determined",
            )
            for one in gains
        ),
    )
    line = (
        f"smallest Cragg-Donald eigenvalue {cragg_donald:.3g}: how well the payload "
        "separates gains and arm"
    )
    values = [f"{one.motor} {one.value:.4g} ± {one.half_width:.2g} {one.unit}" for one in gains]
    short = Section(lines=(f"drive gains: {', '.join(values)}",))
    return [Section(title="drive gains", table=table, lines=(line,), short=short)]


def payload_sections(payloads: Sequence[EstimatedPayload], joint: str) -> list[Section]:
    """The payloads as the nearest bodies of positive density."""
    found = list[Section]()
    heads = columns("", numbers=("value", "±95%")) + columns("unit", "mostly from")
    for one in payloads:
        names, units = ("mass", "centre of mass x", "y", "z", *LINK[:6]), ("kg", *["m"] * 3)
        order = [MASS, *MOMENTS, *range(6)]
        values, half, prior = one.values[order], one.half[order], one.from_prior[order]
        values[1:4], half[1:4] = one.center_of_mass_m
        if one.payload.mass_kg:
            half[0] = one.payload.mass_half_width_kg or np.nan
        known = (one.payload.mass_kg is not None, *[one.payload.center_of_mass_m is not None] * 3)
        rows: list[Row] = [
            (
                name,
                Number(float(value), ".4g"),
                Number(float(width), ".2g"),
                unit,
                "stated" if is_known else "prior" if from_prior else "recording",
            )
            for name, value, width, unit, is_known, from_prior in zip(
                names,
                values,
                half,
                (*units, *["kg m²"] * 6),
                (*known, *[False] * 6),
                prior,
                strict=True,
            )
        ]
        line = (
            f"stated: {one.payload.describe(joint)}; values in the frame of {joint}, inertia "
            "about its origin"
        )
        table = Table(columns=heads, rows=tuple(rows))
        mass = f"payload of {one.recording}: mass {one.values[9]:.4g} kg"
        title, short = f"payload of {one.recording}", Section(lines=(mass,))
        found.append(Section(title=title, table=table, lines=(line,), short=short))
    return found
