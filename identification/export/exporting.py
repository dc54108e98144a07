"""Models in the formats asked for, built before anything is written, and a report on what each cannot say."""

import os
import tomllib
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from acquisition.errors import one_line
from acquisition.files import atomic_write

from ..report import Cell, Document, Number, Section, Table, columns
from .losses import COUNT, Loss, States, random_states, sayable
from .mechanism import Mechanism
from .mjcf import mjcf_text
from .robot_toml import with_parameters
from .urdf import urdf_text

URDF_GRAVITY = (0.0, 0.0, -9.81)  # what readers of a URDF take, which does not say it
SOFT = "MuJoCo's friction loss is a soft constraint: it is dry friction where a joint moves, and creeps where it nearly stands"


def write_models(texts: Mapping[Path, str]) -> None:
    """Write all files; if one of them cannot be written, none is begun under its own name."""
    with ExitStack() as stack:
        for path, text in texts.items():
            stack.enter_context(atomic_write(path)).write_text(text, encoding="utf-8")


def export_model(
    m: Mechanism,
    source: str,
    *,
    urdf: Path | None = None,
    mjcf: Path | None = None,
    toml: Path | None = None,
    lines: tuple[str, ...] = (),
) -> tuple[dict[Path, str], Document]:
    """The model of a fit in the formats asked for.

    `source` names the fit, and `lines` say where its values are from. Returns texts by the path that they are written to, and
    the report on them. Raises `IdentificationError`: where a description cannot be patched.
    """
    texts, sections, states = dict[Path, str](), [Section(lines=lines)], random_states(m)
    if urdf is not None:
        said, losses = sayable(m, states, rotors=False, couplings=False)
        texts[urdf], notes = urdf_text(said)
        gravity = tuple(m.model.robot.gravity)
        if gravity != URDF_GRAVITY:
            notes += (
                f"gravity is {' '.join(f'{g:g}' for g in gravity)} m/s²: a URDF does not say it, set it where it is used",
            )
        sections.append(_section(m, states, urdf, "a URDF", losses, notes))
    if mjcf is not None:
        said, losses = sayable(m, states, rotors=True, couplings=True)
        texts[mjcf] = mjcf_text(said)
        dry = any(m.frictionloss) or any(c.frictionloss for c in m.couplings)
        sections.append(_section(m, states, mjcf, "an MJCF", losses, (SOFT,) if dry else ()))
    if toml is not None:
        texts[toml] = _toml(m, toml, urdf, source)
        sections.append(Section(title=f"{toml}: [parameters], nothing is lost", lines=_beside(m, toml, urdf)))
    return texts, Document(title=f"{m.model.robot.name}: model of {source}", sections=tuple(sections))


def _section(
    m: Mechanism, states: States, path: Path, format_: str, losses: tuple[Loss, ...], notes: tuple[str, ...]
) -> Section:
    """What a format cannot say, joint by joint."""
    if not losses:
        return Section(title=f"{path}: nothing is lost", lines=notes)
    robot, rows = m.model.robot, list[tuple[Cell, ...]]()
    for loss in losses:
        what = loss.what
        for j in np.flatnonzero(loss.rms):
            rms, percent = Number(float(loss.rms[j]), ".4g"), Number(float(loss.percent[j]), ".2f")
            rows.append((what, robot.joints[j].name, rms, robot.effort_units[j], percent))
            what = ""
    table = Table(
        columns=columns(f"what {format_} cannot say", "joint", numbers=("rms of the torque",))
        + columns("unit", numbers=("in %",)),
        rows=tuple(rows),
    )
    lines = (
        f"torque that is missing at {COUNT} random states within the limits of the description, and in percent of it",
    )
    return Section(title=str(path), table=table, lines=(*lines, *notes))


def _toml(m: Mechanism, toml: Path, urdf: Path | None, source: str) -> str:
    """The fit's robot.toml with the values; it names the URDF that is written with it."""
    robot, named = m.model.robot, None
    if robot.urdf is not None and urdf is not None:
        named = Path(os.path.relpath(urdf, toml.absolute().parent)).as_posix()
    values = {name: float(value) for name, value in zip(m.model.names, m.chi, strict=True)}
    text = robot.files["robot.toml"].decode()
    return with_parameters(text, values, f"Physically consistent values identified in {one_line(source)}.", named)


def _beside(m: Mechanism, toml: Path, urdf: Path | None) -> tuple[str, ...]:
    """Lines on files that the robot.toml names and that are not where it looks for them."""
    robot = m.model.robot
    named = [drive.dictionary for drive in robot.bus.drive] if robot.bus else []
    if robot.urdf is not None and urdf is None:
        named.append(tomllib.loads(robot.files["robot.toml"].decode())["urdf"])
    missing = dict.fromkeys(name for name in named if name and not (toml.parent / name).is_file())
    return tuple(f"it names {name}, which is not beside it: copy it there" for name in missing)
