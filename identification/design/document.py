"""The report of a reference: expected intervals beside those of the plain reference, and the limits in use."""

from collections.abc import Sequence

import numpy as np

from ..report import Document, Number, Section, Table, columns
from .design import PLAIN, Excitation
from .limits import FAR_M, KINDS


def excitation_document(excitation: Excitation, warnings: Sequence[str] = ()) -> Document:
    """What a reference is expected to give, and what it takes, with further warnings."""
    e, s = excitation, excitation.settings
    smaller = e.plain / e.sigma
    known = e.beta is not None
    rows = tuple(
        (
            name,
            *((Number(float(e.beta[i]), ".4g"),) if e.beta is not None else ()),
            Number(float(e.half[i]), ".3g"),
            Number(float(e.plain_half[i]), ".3g"),
            Number(float(smaller[i]), ".2f"),
            e.base.units[i],
        )
        for i, name in enumerate(e.base.names)
    )
    headings = (("value",) if known else ()) + ("±95 %", "plain\n±95 %", "times\nsmaller")
    expected = Table(columns=(*columns("parameter", numbers=headings), *columns("unit")), rows=rows)
    noise = ", ".join(f"{x:.3g}" for x in e.noise)
    lines = (
        f"intervals are {np.median(smaller):.2f} times smaller than those of the plain reference in the median, "
        f"{smaller.min():.2f} at least",
        f"plain reference: the geometric mean over {PLAIN} random ones of {s.plain_harmonics} harmonics at the same share of "
        "all limits",
        f"noise of the torque in a row of the fit: {noise} ({', '.join(dict.fromkeys(e.robot.effort_units))}): {e.noise_from}",
        f"torque by {e.beta_from}" if known else "torque not known",
    )
    n = e.robot.n
    names, efforts = (
        [joint.name for joint in e.robot.joints],
        dict(zip(e.limits.names[3 * n : len(e.used)], e.used[3 * n :], strict=True)),
    )
    percent = 100 * e.used[: 3 * n].reshape(3, n)
    table = [
        (
            name,
            *(Number(float(x), ".1f") for x in percent[:, j]),
            _percent(efforts.pop(f"effort of joint {name}", None)),
        )
        for j, name in enumerate(names)
    ]
    table += [(name.removeprefix("effort of "), "", "", "", _percent(x)) for name, x in efforts.items()]
    apart: tuple[str, ...] = ()
    if e.nearest is not None:
        near = "more than " if e.nearest[1] >= FAR_M else ""
        apart = (f"nearest: {e.nearest[0]}, {near}{e.nearest[1]:.3f} m apart",)
    limits = Table(columns=columns("joint", numbers=(*KINDS, "effort")), rows=tuple(table))
    title = (
        f"{e.robot.name}: reference of {s.periods} x {s.period_s:g} s, {s.harmonics} harmonics up to "
        f"{s.harmonics / s.period_s:g} Hz, seed {s.seed}"
    )
    return Document(
        title=title,
        sections=(
            Section(title="expected intervals", table=expected, lines=lines),
            Section(
                title="limits in use, % of the whole limit",
                table=limits,
                lines=apart,
                warnings=(*e.warnings, *warnings),
            ),
        ),
    )


def _percent(share: float | None) -> Number | str:
    return "" if share is None else Number(100 * float(share), ".1f")
