"""Build models in the requested formats before writing any, and report what
each cannot represent.
"""

import os
import re
import tomllib
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.errors import one_line
from acquisition.files import atomic_write, format_numbers

from ..report import Document, Number, Row, Section, Table, columns
from .exported_model import STATES, ExportedModel, Losses, representable
from .formats import mjcf_text, servo_loop, urdf_text
from .tables import checked_toml

URDF_GRAVITY = (0.0, 0.0, -9.81)  # the default of URDF readers: a URDF has no gravity
SOFT_FRICTION = (
    "MuJoCo's frictionloss is a soft constraint: a moving joint has dry friction, a joint near "
    "rest creeps"
)
_TABLE_HEADER = re.compile(
    r"[ \t]*\[[ \t]*(?:parameters|\"parameters\"|'parameters')[ \t]*\][ \t]*(?:#.*)?"
)
_ANY_HEADER = re.compile(r"[ \t]*\[")
_INLINE_TABLE = re.compile(r"[ \t]*parameters[ \t]*[.=]")


def write_models(texts: Mapping[Path, str]) -> None:
    """Write all files; if one cannot be written, none gets its final name."""
    with ExitStack() as stack:
        for path, text in texts.items():
            stack.enter_context(atomic_write(path)).write_text(text, encoding="utf-8")


def export_model(
    m: ExportedModel,
    source: str,
    *,
    urdf: Path | None = None,
    mjcf: Path | None = None,
    toml: Path | None = None,
    lines: tuple[str, ...] = (),
) -> tuple[dict[Path, str], Document]:
    """A model in the requested formats, by path, and a report; `source` names the fit, `lines`
    the origin of its values.
    """
    robot, texts, sections = m.model.robot, dict[Path, str](), [Section(lines=lines)]
    if urdf is not None:
        represented, losses = representable(m, motors=False)
        texts[urdf], notes = urdf_text(represented)
        if tuple(robot.gravity) != URDF_GRAVITY:
            gravity = " ".join(f"{g:g}" for g in robot.gravity)
            notes += (f"gravity is {gravity} m/s²: not in a URDF, set it in the simulator",)
        sections.append(_make_section(m, f"{urdf}", "a URDF", losses, notes))
    if mjcf is not None:
        represented, losses = representable(m, motors=True)
        texts[mjcf] = mjcf_text(represented)
        notes = (SOFT_FRICTION,) if m.frictionloss.any() else ()
        if (loop := servo_loop(represented)) is not None:
            integral = ", integral" if loop.Ki.any() else ""
            gravity = ", gravity feed-forward" if loop.gravity == "measured" else ""
            two = (
                "; forcerange limits each of a motor's two, not their sum"
                if loop.feedforward and any(np.isfinite(loop.saturation))
                else ""
            )
            notes += (
                f"actuators follow positions by {robot.controller.structure}, without its "
                f"sampling{integral}{gravity}{two}",
            )
        sections.append(_make_section(m, f"{mjcf}", "an MJCF", losses, notes))
    if toml is not None:
        texts[toml], notes = _make_toml(m, toml, urdf, source)
        sections.append(Section(title=f"{toml}: [parameters], complete", lines=notes))
    return texts, Document(title=f"{robot.name}: model of {source}", sections=tuple(sections))


def _make_section(
    m: ExportedModel, title: str, format_: str, losses: Losses, notes: tuple[str, ...]
) -> Section:
    """The losses of a format for each joint."""
    if not losses:
        return Section(title=f"{title}: complete", lines=notes)
    robot = m.model.robot
    rows: list[Row] = [
        (
            "" if k else what,
            robot.joints[j].name,
            Number(float(rms[j]), ".4g"),
            robot.effort_units[j],
            Number(float(percent[j]), ".2f"),
        )
        for what, (rms, percent) in losses.items()
        for k, j in enumerate(np.flatnonzero(rms))
    ]
    heads = columns(f"not representable in {format_}", "joint", numbers=("rms torque",))
    return Section(
        title=title,
        table=Table(columns=heads + columns("unit", numbers=("in %",)), rows=tuple(rows)),
        lines=(
            f"missing torque at {STATES} random states within the description's limits; in %: "
            "of the whole torque",
            *notes,
        ),
    )


def _make_toml(
    m: ExportedModel, toml: Path, urdf: Path | None, source: str
) -> tuple[str, tuple[str, ...]]:
    """The fit's robot.toml with the values and the URDF written with it; lines on files that it
    names but are missing.
    """
    robot, text = m.model.robot, m.model.robot.files["robot.toml"].decode()
    values = {name: float(value) for name, value in zip(m.model.names, m.chi, strict=True)}
    named, files = None, [drive.dictionary for drive in robot.bus.drive] if robot.bus else []
    if robot.urdf is not None and urdf is not None:
        named = Path(os.path.relpath(urdf, toml.absolute().parent)).as_posix()
    elif robot.urdf is not None:
        files.append(tomllib.loads(text)["urdf"])
    missing = dict.fromkeys(name for name in files if name and not (toml.parent / name).is_file())
    remark = f"Physically consistent values identified in {one_line(source)}."
    return replace_parameters(text, values, remark, named), tuple(
        f"it names {name}, which is missing in its folder: copy it there" for name in missing
    )


def replace_parameters(
    text: str, values: Mapping[str, float], remark: str, urdf: str | None = None
) -> str:
    """Replace the values (SI) of `[parameters]` in a description, or append the
    table; all other lines stay.

    The remark, on the origin of the values, replaces the remarks directly above the table; the name
    `urdf` replaces the URDF's. Raises `BadInputError`: the table cannot be replaced line by line.
    """
    was, written = (
        tomllib.loads(text),
        {name: format_numbers(value) for name, value in values.items()},
    )
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines) if _TABLE_HEADER.fullmatch(line)), None)
    if start is None:
        before = [line for line in lines if not ("parameters" in was and _INLINE_TABLE.match(line))]
        after = list[str]()
    else:
        stop = next(
            (i for i in range(start + 1, len(lines)) if _ANY_HEADER.match(lines[i])), len(lines)
        )
        while stop > start + 1 and not lines[stop - 1].strip().partition("#")[0]:
            stop -= 1  # blank lines and remarks above the next table belong to that table
        while start and lines[start - 1].lstrip().startswith("#"):
            start -= 1
        before, after = lines[:start], lines[stop:]
    while before and not before[-1].strip():
        before.pop()
    now: dict[str, Any] = was | {
        "parameters": {name: float(value) for name, value in written.items()}
    }
    if urdf is not None:
        now["urdf"], quoted = urdf, '"' + urdf.replace("\\", "\\\\").replace('"', '\\"') + '"'
        before = [f"urdf = {quoted}" if re.match(r"urdf[ \t]*=", line) else line for line in before]
    return checked_toml(
        "\n".join(
            [
                *before,
                "",
                f"# {remark}",
                "[parameters]",
                *map(" = ".join, written.items()),
                *after,
            ]
        )
        + "\n",
        now,
        "the fit's robot.toml",
        "[parameters]",
        "one line per value under a line [parameters]",
    )
