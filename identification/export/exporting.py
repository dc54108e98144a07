"""Export a fit: read it as a robot with all standard parameters, make it consistent if it is not,
build models in the requested formats before writing any, and report what each cannot represent.
"""

import os
import tomllib
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from msgspec import UNSET

from acquisition.errors import one_line
from acquisition.files import atomic_write, refuse_clash

from ..arrays import Array
from ..errors import BadInputError
from ..model import SHAPES, InverseModel, base_parameters
from ..report import Document, FitFile, Number, Row, Section, Table, base_name, columns
from ..results import Known, consistent_set, refuse_unknown_gain, stored_beta, stored_robot
from .exported_model import STATES, ExportedModel, Losses, representable, split_parameters
from .formats import mjcf_text, servo_loop, urdf_text
from .tables import replace_parameters, with_findings

SOFT_FRICTION = (
    "MuJoCo's frictionloss is a soft constraint: a moving joint has dry friction, a joint near "
    "rest creeps"
)


def export_fit(
    stored: FitFile, place: str, *, untrusted: bool = False, **outputs: Path | None
) -> Document:
    """Write a fit as `urdf`, `mjcf` or `toml`, and report what each format cannot represent.

    Raises `BadInputError`: the fit is not to be used and not allowed as
        `untrusted`; as of `model_of_fit`.
    """
    refuse_clash((), of_kinds=outputs)
    reasons = [f"{place}: verdict {stored.verdict}"] * (stored.verdict == "do not use")
    if stored.verdict is UNSET:  # in files of earlier versions
        reasons = stored.warnings_of(place)
    if reasons and not untrusted:
        raise BadInputError(
            f"not exported: {'; '.join(reasons)}",
            expected="a fit to be trusted, or --allow-untrusted",
        )
    mechanism, lines = model_of_fit(stored, place)
    texts, document = export_model(mechanism, Path(place).name, lines=lines, **outputs)
    write_models(texts)
    return document.followed_by(Section(warnings=tuple(reasons))) if reasons else document


def model_of_fit(stored: FitFile, place: str) -> tuple[ExportedModel, tuple[str, ...]]:
    """The robot of a fit, by its own description and drive gains, with all standard parameters;
    lines on their origin.
    """
    stored, lines = with_findings(stored, place)
    robot = stored_robot(stored, place)
    refuse_unknown_gain(robot)
    model = InverseModel(robot)
    if stored.standard_parameters is UNSET:
        chi, line = _make_consistent(stored, model, place)
        return split_parameters(model, chi, place), (*lines, line)
    parameters, names = stored.standard_parameters, list(zip(model.names, model.units, strict=True))
    if [(p.name, p.unit) for p in parameters] != names:
        raise BadInputError(
            place=place,
            key="standard_parameters",
            value=next(
                (f"{p.name} in {p.unit}" for p in parameters if (p.name, p.unit) not in names), None
            ),
            expected=f"the {len(names)} of the description",
        )
    if (c := stored.consistent) is not UNSET:
        lines.append(
            f"the consistent parameters of {place}: prior {c.prior}, weight "
            f"{c.prior_weight:g}; chi² {c.chi2:.3g}, largest move {c.largest_move:.2g} "
            f"half-widths of the 95 % interval, of {c.moved_most}"
        )
    return split_parameters(model, np.array([p.value for p in parameters]), place), tuple(lines)


def _make_consistent(stored: FitFile, model: InverseModel, place: str) -> tuple[Array, str]:
    left_out = {p.name: p.sigma for p in stored.left_out or ()}
    given, base = {base_name(p.name) for p in stored.parameters}, base_parameters(model)
    # Further friction terms may be left out altogether, which is not to estimate them as zero.
    shapes = {term.name for term in model.terms.values() if term.kind in SHAPES}
    base = base.without(shapes - given - left_out.keys())
    beta = stored_beta(stored, base, place)
    if stored.covariance is UNSET:
        raise BadInputError(
            "the fit is not consistent, and cannot be made so without it",
            place=place,
            key="covariance",
            value=None,
            expected="a new fit, preferably with --consistent",
        )
    names, values = stored.covariance.names, np.array(stored.covariance.values)
    shared = [base_name(name) for name in names]
    missing = [name for name in base.names if name not in shared and name not in left_out]
    if missing or values.shape != (len(names), len(names)):
        raise BadInputError(
            place=place,
            key="covariance",
            value=", ".join(missing[:5]) or None,
            expected="one row per parameter",
        )
    # of parameters of single recordings the mean, as in `stored_beta`
    mean = np.array([[(own == name) / shared.count(own) for own in shared] for name in base.names])
    covariance = (
        np.diag([left_out.get(name, 0.0) ** 2 for name in base.names]) + mean @ values @ mean.T
    )
    sigma = dict(zip(names, np.sqrt(np.diag(values)), strict=True))
    reach = float(
        np.median([p.half / sigma[p.name] for p in stored.parameters if sigma.get(p.name)] or [1.0])
    )
    c, parameters = consistent_set(
        model, base, Known(beta=beta, covariance=covariance, reach=reach)
    )
    return np.array([p.value for p in parameters]), (
        f"{place} is not consistent: the nearest consistent parameters are used; prior {c.prior}; "
        f"added chi² {c.chi2:.3g} on {base.b} parameters, largest move "
        f"{c.largest_move:.2g} half-widths of the 95 % interval, of {c.moved_most}; certificate "
        f"{c.certificate:.1e}"
    )


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
        if tuple(robot.gravity) != (0.0, 0.0, -9.81):  # the default of URDF readers
            gravity = " ".join(f"{g:g}" for g in robot.gravity)
            notes += (f"gravity is {gravity} m/s²: not in a URDF, set it in the simulator",)
        sections.append(_make_section(m, f"{urdf}", "a URDF", losses, notes))
    if mjcf is not None:
        represented, losses = representable(m, motors=True)
        texts[mjcf] = mjcf_text(represented)
        notes = (SOFT_FRICTION,) if m.frictionloss.any() else ()
        if (loop := servo_loop(represented)) is not None:
            details = {
                ", integral": loop.Ki.any(),
                ", gravity feed-forward": loop.gravity == "measured",
                "; forcerange limits each of a motor's two, not their sum": loop.feedforward
                and any(np.isfinite(loop.saturation)),
            }
            notes += (
                f"actuators follow positions by {robot.controller.structure}, without its "
                f"sampling{''.join(text for text, said in details.items() if said)}",
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
