"""Make arms.md, and the models for MuJoCo, from the fits in arms/.

`python replay_data/arms.py` reads NAME.json (a fit) and NAME.toml (where its record is from) of
each arm, and writes NAME.xml and arms.md. It fits nothing.
"""

import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

import identification
from identification.errors import BadInputError
from identification.export import export_fit
from identification.report import Document, Number, Section, Table, columns, to_markdown
from identification.results import PARAMETERS

HERE = Path(__file__).resolve().parent
METHODS = {"iv": "IV", "wls": "weighted LS", "ols": "LS"}
HEAD = """# Arms with numbers

These are parameters of real machines. This program identified them from records that others
published, and each fit shows how far you can rely on its values. The folder `arms/` has three files
for each: the fit (`NAME.json`), where its record is from (`NAME.toml`), and a model for MuJoCo
(`NAME.xml`). `python replay_data/arms.py` makes the models and this page from the first two, so do
not edit them. [Reading a fit](../identification/docs/reading-a-fit.md) explains the terms. To
compare your own robot with one of these:

    robot-identify compare mine.json replay_data/arms/ur10e.json
    robot-identify validate replay_data/arms/ur10e.json mine.mcap

The torque error is that of the rows in motion. *Held out* is the error of predictions by fits of
the other parts of the record. *Well determined* are the parameters that the record needs to explain
the torque.

"""
BEFORE = """
An earlier version of this program made the fits of {arms}. Their torque errors are those of
filtered torques, and their numbers have nine digits.
"""
ADD = """
## Add an arm

1. Fit a record that others can get: `robot-identify fit LOG.mcap --json NAME.json`. Store the fit
   in `replay_data/arms/`.
2. Copy the `NAME.toml` of another arm. Say where the record is from, its licence, and the commands
   that repeat the fit.
3. Never add the record, or anything else whose licence forbids it. Parameters are facts; the
   description of the robot must be your own.
4. Run `python replay_data/arms.py`. It adds the arm to this page and writes its model.
5. Run `pytest tests/product/test_arms.py`, and commit the three files and this page.
"""


class Published(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What others published on the same record: values by parameter, or figures by our words.

    A figure is that of others and ours; `source` is Markdown.
    """

    source: str
    values: dict[str, float] = {}
    figures: dict[str, tuple[str, str]] = {}


class Origin(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a fit does not know: the arm's name, its record, and how to repeat the fit.

    All texts are Markdown; `repeat` are commands, a line each, and `missing` what they lack.
    """

    arm: str
    record: str
    origin: str
    licence: str
    fit: str
    repeat: str
    missing: str = ""
    published: list[Published] = []


@dataclass(frozen=True)
class Arm:
    """An arm of the page, by the name of its files."""

    name: str
    origin: Origin
    fit: identification.Fit


def read_arms(folder: Path) -> list[Arm]:
    """Read the arms in a folder, by name."""
    return [
        Arm(
            path.stem,
            msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Origin),
            identification.read_fit(path.with_suffix(".json")),
        )
        for path in sorted(folder.glob("*.toml"))
    ]


def to_text(*sections: Section) -> str:
    """Return sections as Markdown without a headline."""
    return to_markdown(Document(title="", sections=sections)).partition("\n\n")[2]


def overview(arms: list[Arm]) -> str:
    """Return the table of all arms."""
    heads = columns("arm", "joints", "method", "verdict")
    heads += columns(numbers=("torque error, %", "held out, %", "well determined"))
    rows = []
    for arm in arms:
        file = arm.fit.file
        rows.append(
            (
                f"[{arm.origin.arm}](#{anchor(arm.origin.arm)})",
                str(len(file.joints)),
                METHODS[file.method],
                str(arm.fit.verdict),
                Number(file.moving_relative_error_percent, ".3g"),
                Number(file.held_out_error_percent, ".3g"),
                f"{sum(p.essential for p in file.parameters)} of {file.size}",
                arm.origin.origin,
                arm.origin.licence,
            )
        )
    heads += columns("record", "its licence")
    before = [arm.origin.arm for arm in arms if arm.fit.file.error_cutoff_hz is None]
    told = BEFORE.format(arms=" and ".join(filter(None, [", ".join(before[:-1]), *before[-1:]])))
    return to_text(Section(table=Table(columns=heads, rows=tuple(rows)))) + told * bool(before)


def anchor(heading: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def values_of(arm: Arm) -> Section:
    """Make the table of all well-determined parameters, from the report of the fit."""
    (table,) = (x.table for x in arm.fit.document.sections if x.title == PARAMETERS)
    names = [name for name, _ in table.columns]
    kept = [names.index(x) for x in ("parameter", "value", "95 % half-width", "unit", "meaning")]
    return Section(
        table=Table(
            columns=tuple(table.columns[k] for k in kept),
            rows=tuple(tuple(row[k] for k in kept) for row in table.rows if row[-1] == "yes"),
        )
    )


def model_text(arm: Arm, out: Path) -> str:
    """Write the model of an arm into a folder; say what it lacks, or why there is none."""
    path = out / f"{arm.name}.xml"
    try:
        made, found = export_fit(arm.fit.file, f"{arm.name}.json", mjcf=path).sections[:2]
    except BadInputError as refused:
        return f"There is no model for MuJoCo: {refused}\n"
    lines = (re.sub(r"; Newton decrement.*", "", line) for line in (*made.lines, *found.lines))
    rows = (
        tuple(replace(x, form=".2g") if isinstance(x, Number) else x for x in row)
        for row in (found.table.rows if found.table else ())
    )
    table = found.table and replace(found.table, rows=tuple(rows))
    text = to_text(
        Section(table=table), Section(lines=tuple(f"{x[:1].upper()}{x[1:]}." for x in lines))
    )
    summary = "What the model lacks, and how it was made"
    lacks = ", which lacks a part of the torque (see below)" * (found.table is not None)
    return f"[Model for MuJoCo](arms/{path.name}){lacks}\n\n{hidden(summary, text)}"


def published_text(arm: Arm) -> Iterator[str]:
    """Yield what others published on the same record, beside ours."""
    ours = {p.name: p for p in arm.fit.parameters}
    if not arm.origin.published:
        yield "We know of no published figure of the same quantity on the same samples.\n"
    for one in arm.origin.published:
        rows = [
            (
                f"{name}, {ours[name].unit}",
                str(value),
                f"{ours[name].value:.4g} ± {ours[name].half:.2g}",
            )
            for name, value in one.values.items()
        ]
        rows += [(what, *pair) for what, pair in one.figures.items()]
        yield f"Published: {one.source}\n"
        yield to_text(
            Section(
                table=Table(
                    columns=columns("what", numbers=("published", "ours")), rows=tuple(rows)
                )
            )
        )


def hidden(title: str, text: str) -> str:
    """Return text that GitHub shows when its title is clicked."""
    return f"<details><summary>{title}</summary>\n\n{text}\n</details>\n"


def part(arm: Arm, out: Path) -> str:
    """Return the part of the page on an arm; write its model into a folder."""
    origin, document = arm.origin, arm.fit.document
    verdict, summary = document.short.sections[:2]
    parameters = values_of(arm)
    rows = parameters.table.rows
    commands = "".join(f"    {line}\n" for line in origin.repeat.strip().splitlines())
    return "\n".join(
        [
            f"\n## {origin.arm}\n",
            origin.record.lstrip(),
            origin.fit.lstrip(),
            f"**{document.title}. {verdict.title}**\n",
            to_text(replace(verdict, title=""), summary),
            f"To repeat the fit:\n\n{commands}",
            *([f"{origin.missing.strip()}\n"] if origin.missing else []),
            *published_text(arm),
            hidden(f"All {len(rows)} well-determined parameters", to_text(parameters)),
            model_text(arm, out),
        ]
    )


def page(folder: Path, out: Path) -> str:
    """Return the page of the arms in a folder; write their models into the folder `out`."""
    arms = read_arms(folder)
    return HEAD + overview(arms) + "".join(part(arm, out) for arm in arms) + ADD


if __name__ == "__main__":
    (HERE / "arms.md").write_text(page(HERE / "arms", HERE / "arms"), encoding="utf-8")
