"""Export a fit in the requested formats, and report what each cannot represent.

A fit is read as a robot with all standard parameters, which are made physically consistent if they
are not. All models are built before any file is written. In a description only values in its tables
change; all other lines stay as they are.
"""

import json
import os
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET, structs

from acquisition.errors import COMMAND_LINE, Location, one_line
from acquisition.files import atomic_write, format_numbers, refuse_clash

from ..model import InverseModel
from ..report import (
    Document,
    DriveGain,
    FitFile,
    Number,
    Section,
    Table,
    columns,
)
from ..results import (
    Draws,
    consistent_set,
    draw_consistent,
    refuse_unknown_gain,
    stored_estimate,
    stored_robot,
)
from .exported_model import STATES, ExportedModel, Losses, representable, split_parameters
from .formats import mjcf_text, servo_loop, urdf_text

SOFT_FRICTION = (
    "MuJoCo's frictionloss is a soft constraint: a joint near rest creeps, a moving joint has its "
    "full friction"
)
MIN_DRAWS = 20  # for a comparison of their spread with the intervals
MIN_SPREAD = 0.9  # of the interval; parameters with less spread in the draws are reported
# The table with the remarks directly above it, up to blank lines and remarks above the next table.
_PARAMETERS = re.compile(
    r"(?m)(?:^[ \t]*#.*\n)*^[ \t]*\[[ \t]*([\"']?)parameters\1[ \t]*\][ \t]*(?:#.*)?\n"
    r"(?:(?![ \t]*\[).*\n)*?(?=(?:[ \t]*(?:#.*)?\n)*(?:[ \t]*\[|\Z))"
)
_LIST = r"\[(?:[^\[\]]|\[[^\[\]]*\])*\]"  # which may have lists in it


def export_fit(
    stored: FitFile,
    place: str,
    *,
    untrusted: bool = False,
    drawn: tuple[int, int] = (0, 1),
    say: Callable[[str], None] = lambda text: None,
    **outputs: Path | None,
) -> Document:
    """Write a fit as `urdf`, `mjcf` or `toml`, and report what each format cannot represent.

    The models of draws from the intervals of the fit get the numbered names of the outputs.

    Parameters
    ----------
    stored : the fit.
    place : its file, for errors.
    untrusted : True to export a fit with the verdict `do not use`.
    drawn : number of draws, and their seed.
    say : shows the progress.
    outputs : files by format.

    Raises
    ------
    BadInputError : the fit is not to be used; or as in `model_of_fit`.
    """
    refuse_clash((), of_kinds=outputs)
    draws, seed = drawn
    COMMAND_LINE.require(min(drawn) >= 0, "draws, seed", drawn, "whole numbers, 0 or greater")
    numbered: list[dict[str, Any]] = [
        {
            kind: path and path.parent / f"{path.stem}_{k:0{len(str(draws))}}{path.suffix}"
            for kind, path in outputs.items()
        }
        for k in range(1, draws + 1)
    ]
    for files in numbered:
        refuse_clash((), *outputs.values(), of_kinds=files)
    reasons = (
        stored.warnings_of(place)
        if stored.verdict is UNSET  # in files of earlier versions
        else [f"{place}: verdict {stored.verdict}"] * (stored.verdict == "do not use")
    )
    COMMAND_LINE.require(
        untrusted or not reasons,
        text=f"the fit is not exported: {'; '.join(reasons)}",
        advice="Export a trusted fit, or allow others",
        arguments=("allow_untrusted",),
    )
    (m, lines), source = model_of_fit(stored, place), Path(place).name
    texts, document = export_model(m, source, lines=lines, **outputs)
    if draws:
        say(f"drawing {draws} models")
        found = draw_consistent(m.model, *stored_estimate(stored, m.model, place), m.chi, drawn)
        for k, (files, chi) in enumerate(zip(numbered, found.chi, strict=True), start=1):
            say(f"writing draw {k} of {draws}")
            texts |= export_model(
                split_parameters(m.model, chi, place),
                f"{source}, draw {k} of {draws}, seed {seed}",
                **files,
            )[0]
        document = document.followed_by(_draws_section(found, numbered, seed))
    write_models(texts)
    return document.followed_by(Section(warnings=tuple(reasons))) if reasons else document


def model_of_fit(stored: FitFile, place: str) -> tuple[ExportedModel, tuple[str, ...]]:
    """Return the robot of a fit with all standard parameters, and lines on their origin.

    It has the description of the fit, with its drive gains.
    """
    stored, lines = with_findings(stored, place)
    model = InverseModel(stored_robot(stored, place))
    refuse_unknown_gain(model.robot)
    parameters, c = tuple(stored.standard_parameters or ()), stored.consistent
    if not parameters:
        base, estimate, _ = stored_estimate(stored, model, place)
        c, parameters = consistent_set(model, base, estimate)
        lines.append(
            f"the parameters of {place} were adjusted to be physically consistent: largest change "
            f"{c.largest_move:.2g} half-widths of the 95 % interval, of {c.moved_most}; increase "
            f"of chi² {c.chi2:.3g} over {base.b} parameters; a priori values from {c.prior}; "
            f"Newton decrement {c.certificate:.1e}"
        )
    elif c is not UNSET:
        lines.append(
            f"the physically consistent parameters of {place}: largest change "
            f"{c.largest_move:.2g} half-widths of the 95 % interval, of {c.moved_most}; increase "
            f"of chi² {c.chi2:.3g}; a priori values (weight {c.prior_weight:g}) from {c.prior}"
        )
    names = list(zip(model.names, model.units, strict=True))
    Location(place).require(
        [(p.name, p.unit) for p in parameters] == names,
        "standard_parameters",
        next((f"{p.name} in {p.unit}" for p in parameters if (p.name, p.unit) not in names), None),
        f"the {len(names)} parameters of the description",
    )
    return split_parameters(model, np.array([p.value for p in parameters]), place), tuple(lines)


def _draws_section(found: Draws, files: Sequence[Mapping[str, Path | None]], seed: int) -> Section:
    """Make the section of draws in numbered files, with the intervals that they do not fill."""
    return Section(
        title=f"{len(files)} draws: "
        + ", ".join(f"{files[0][kind]} to {last}" for kind, last in files[-1].items() if last),
        lines=(
            f"drawn around the model with the 95 % intervals and the correlations of the fit (C), "
            f"seed {seed}, and made physically consistent; not drawn: drive gains, parameters that "
            "the fit left out, and values that no torque depends on",
            "largest change of each draw for physical consistency, in half-widths: "
            f"median {np.median(found.changes):.2g}, largest {found.changes.max():.2g}",
            *(
                f"{text}: {', '.join(parts)}"
                for text, parts in {
                    "at a bound of physical consistency, in percent of the draws": [
                        f"{text} {100 * share:.0f}" for text, share in found.at_bound.items()
                    ],
                    "spread below 90 % of the interval, in percent of it": [
                        f"{name} {100 * share:.0f}"
                        for name, share in found.narrowed.items()
                        if share < MIN_SPREAD and len(files) >= MIN_DRAWS
                    ],
                }.items()
                if parts
            ),
            *[f"fewer than {MIN_DRAWS} draws: their spread is not compared with the intervals"]
            * (len(files) < MIN_DRAWS),
        ),
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
    """Make the texts of a model in the requested formats, by path, and a report.

    Parameters
    ----------
    m : the model.
    source : name of the fit.
    urdf, mjcf, toml : files to be written.
    lines : lines on the origin of its values.
    """
    robot, texts, sections = m.model.robot, dict[Path, str](), [Section(lines=lines)]
    if urdf is not None:
        represented, losses = representable(m, motors=False)
        texts[urdf], notes = urdf_text(represented)
        if tuple(robot.gravity) != (0.0, 0.0, -9.81):  # the default of URDF readers
            gravity = " ".join(f"{g:g}" for g in robot.gravity)
            notes += (f"a URDF has no gravity: set {gravity} m/s² in the simulator",)
        sections.append(_make_section(m, f"{urdf}", "a URDF", losses, notes))
    if mjcf is not None:
        represented, losses = representable(m, motors=True)
        texts[mjcf] = mjcf_text(represented)
        notes = (SOFT_FRICTION,) if m.frictionloss.any() else ()
        if (loop := servo_loop(represented)) is not None:
            details = {
                ", integral": loop.Ki.any(),
                ", gravity feed-forward": loop.gravity == "measured",
                "; forcerange limits each actuator of a motor, not their sum": loop.feedforward
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
    """Make the section of a format, with its losses for each joint."""
    if not losses:
        return Section(title=f"{title}: complete", lines=notes)
    robot = m.model.robot
    return Section(
        title=title,
        table=Table(
            columns=columns(f"not representable in {format_}", "joint", numbers=("rms torque",))
            + columns("unit", numbers=("relative, %",)),
            rows=tuple(
                (
                    "" if k else what,
                    robot.joints[j].name,
                    Number(float(rms[j]), ".4g"),
                    robot.effort_units[j],
                    Number(float(percent[j]), ".2f"),
                )
                for what, (rms, percent) in losses.items()
                for k, j in enumerate(np.flatnonzero(rms))
            ),
        ),
        lines=(
            f"Missing torque at {STATES} random states within the limits of the robot, also "
            "relative to the whole torque",
            *notes,
        ),
    )


def _make_toml(
    m: ExportedModel, toml: Path, urdf: Path | None, source: str
) -> tuple[str, tuple[str, ...]]:
    """Return the fit's robot.toml with the values, and lines on files that it lacks.

    It refers to the URDF that is written with it.
    """
    robot, text = m.model.robot, m.model.robot.files["robot.toml"].decode()
    values = dict(zip(m.model.names, m.chi.tolist(), strict=True))
    named, files = None, [drive.dictionary for drive in robot.bus.drive] if robot.bus else []
    if robot.urdf is not None and urdf is not None:
        named = Path(os.path.relpath(urdf, toml.absolute().parent)).as_posix()
    elif robot.urdf is not None:
        files.append(tomllib.loads(text)["urdf"])
    missing = dict.fromkeys(name for name in files if name and not (toml.parent / name).is_file())
    remark = f"Physically consistent values identified in {one_line(source)}."
    return replace_parameters(text, values, remark, named), tuple(
        f"it refers to {name}, which is not in its folder: copy it there" for name in missing
    )


def replace_in_tables(
    text: str,
    kind: str,
    values: Mapping[str, Mapping[str, Any]],
    place: str,
    remark: str = "",
) -> str:
    """Return a description with new values in its tables of a kind.

    Parameters
    ----------
    text : the description.
    kind : name of the tables, [[kind]]; empty for the top level, which has the robot's name.
    values : values by key, by the name in the table; a key with the value None becomes a comment.
    place : name of the description, for errors.
    remark : a comment above each new value, if any.

    Raises
    ------
    BadInputError : the tables cannot be replaced line by line.
    """
    now = tomllib.loads(text)
    owns = now[kind] if kind else [now]
    header = rf"(?m)^([ \t]*\[\[[ \t]*{kind}[ \t]*\]\][ \t]*(?:#.*)?)$"
    head = (
        text if kind else re.split(r"(?m)^(?=[ \t]*\[\[?[ \t]*[A-Za-z_\"'])", text, maxsplit=1)[0]
    )
    made, *tables = re.split(header, text) if kind else ["", "", f"\n{head}"]
    # Each header is followed by the lines of its table.
    for own, header, table in zip(owns, tables[::2], tables[1::2], strict=False):
        for key, value in values.get(own["name"], {}).items():
            line = re.compile(
                rf"(?m)^([ \t]*{key}[ \t]*=[ \t]*)(?:{_LIST}|[^#\n]*?)([ \t]*(?:#.*)?)$"
            )
            if value is None:
                own.pop(key, None)
                table = line.sub(r"# \g<0>", table)
                continue
            own[key], above = value, f"# {remark}\n" * bool(remark)
            shown = json.dumps(value, ensure_ascii=False).replace("\\", r"\\")
            table, found = line.subn(rf"{above}\g<1>{shown}\g<2>", table, count=1)
            # A new key goes after the first one.
            if not found:
                table = re.sub(r"^\n[^\n]*", rf"\g<0>\n{above}{key} = {shown}", table)
        made += header + table
    made = (
        made[not kind :] + text[len(head) :]
        if values.keys() <= {x["name"] for x in owns[: len(tables) // 2]}
        else ""
    )
    key, lines = (
        (f"[[{kind}]]", f"a line [[{kind}]] for each, then ") if kind else ("top level", "")
    )
    return checked_toml(made, now, place, key, f"{lines}one line per key")


def checked_toml(made: str, now: Mapping[str, Any], place: str, key: str, layout: str) -> str:
    """Check that an edited description, `made`, holds the values `now`; return it.

    `key` is what was edited.

    Raises
    ------
    BadInputError : the lines do not have this `layout`.
    """
    with suppress(tomllib.TOMLDecodeError):
        if tomllib.loads(made) == now:
            return made
    Location(place).refuse(key, text="cannot be replaced line by line", advice=f"Write {layout}")


def replace_parameters(
    text: str, values: Mapping[str, float], remark: str, urdf: str | None = None
) -> str:
    """Replace the values of `[parameters]` in a description, or append the table.

    All other lines stay, except for remarks directly above the table.

    Parameters
    ----------
    text : the description.
    values : values by name, SI.
    remark : origin of the values, which replaces the remarks above the table.
    urdf : name of the URDF; None to keep it.

    Raises
    ------
    BadInputError : the table cannot be replaced line by line.
    """
    shown = {name: format_numbers(x) for name, x in values.items()}
    if urdf is not None:
        name = tomllib.loads(text)["name"]
        text = replace_in_tables(text, "", {name: {"urdf": urdf}}, "the fit's robot.toml")
    now: dict[str, Any] = tomllib.loads(text)
    inline = "parameters" in now and re.compile(r"(?m)^[ \t]*parameters[ \t]*[.=].*\n?")
    before, after = text, ""
    if found := _PARAMETERS.search(f"{text}\n"):
        before, after = text[: found.start()], text[found.end() :]
    elif inline:
        before = inline.sub("", text)
    table = ["", f"# {remark}", "[parameters]", *map(" = ".join, shown.items())]
    return checked_toml(
        "\n".join([before.rstrip(), *table, after]),
        now | {"parameters": {name: float(x) for name, x in shown.items()}},
        "the fit's robot.toml",
        "[parameters]",
        "one line per value under a line [parameters]",
    )


def with_findings(stored: FitFile, place: str) -> tuple[FitFile, list[str]]:
    """Return the fit with its findings in its description, and lines on them.

    Findings are its drive gains, and the control law of its recording if none is given. A gain that
    is not well determined stays as given; without a given one it is written with its wide interval.

    Raises
    ------
    BadInputError : a table cannot be replaced line by line.
    """
    text, lines = stored.description.get("robot.toml", ""), list[str]()
    place = f"the robot.toml in {place}"
    if text and stored.gains is not UNSET:
        written = {
            gain.motor: ({"drive_gain_half_width": gain.half_width} if gain.half_width > 0 else {})
            | {"drive_gain_unit": gain.unit, "drive_gain": gain.value}
            for gain in stored.gains
            if gain.determined or gain.described is None
        }
        text = replace_in_tables(text, "motor", written, place)
        lines += [_gain_line(gain, written=gain.motor in written) for gain in stored.gains]
    described = (whole := tomllib.loads(text)).get("controller", {})
    law = None if stored.law is UNSET or "structure" in described else stored.law
    if text and law is not None and law.controller is not None:
        keys = {key: value for key, value in law.controller.items() if key not in described}
        table = "".join(f"\n{key} = {json.dumps(value)}" for key, value in keys.items())
        # The table may have only remarks, which the parser does not show.
        header = r"(?m)^[ \t]*\[[ \t]*controller[ \t]*\].*$"
        made, found = re.subn(header, rf"\g<0>{table}", text, count=1)
        text = checked_toml(
            made if found else f"{text}\n[controller]{table}\n",
            whole | {"controller": described | keys},
            place,
            "[controller]",
            "a line [controller], then one line per key",
        )
        lines.append(f"control law of the recording: {law.structure}")
    if lines:
        stored = structs.replace(stored, description={**stored.description, "robot.toml": text})
    return stored, lines


def _gain_line(gain: DriveGain, *, written: bool) -> str:
    done = "as identified" if written else "as given"
    if not gain.determined:
        done += ", since none is given" * (gain.described is None) + "; not well determined"
    return (
        f"drive gain of {gain.motor} {done}: {gain.value:.4g} ± {gain.half_width:.2g} {gain.unit}"
    )
