"""A proposed map.toml, completed by what a user knows of the table."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..errors import COMMAND_LINE, Location
from ..files import TableColumn
from ..robot import FILL_IN
from .column_words import GIVEN, KIND, TOKEN, UNIT, UNITS
from .quantities import EFFORT_UNITS

QUANTITIES = ("time", "position", "velocity", "reference", "effort")
# By key of the map, the answer that completes it, and what follows its unit.
_ANSWERS = {
    "sample_rate_hz": ("columns", ""),
    "time.unit": ("columns", ""),
    "position.columns": ("columns", ""),
    "effort.columns": ("columns", ""),
    "position.unit": ("position_unit", ""),
    "position.side": ("position_unit", ""),
    "reference.unit": ("position_unit", ""),
    "reference.side": ("position_unit", ""),
    "velocity.unit": ("position_unit", "/s"),
    "velocity.side": ("position_unit", ""),
    "effort.unit": ("effort_unit", ""),
}


def split_columns(text: str) -> tuple[dict[str, list[str]], float | None]:
    """Split columns as `position=2-7,effort=8-13,rate=250`.

    Returns
    -------
    For each quantity names of columns, or numbers from 1; and the sample rate in Hz, if any.

    Raises
    ------
    BadInputError : the text has another form.
    """
    _, *parts = re.split(r"(?:^|,)\s*(\w+)\s*=\s*", text)
    found = dict(zip(parts[::2], parts[1::2], strict=True))
    rate = re.fullmatch(r"[0-9.]+", found.pop("rate", "1"))
    COMMAND_LINE.require(
        parts and rate and {*found} <= {*QUANTITIES} and all(found.values()),
        "columns",
        text,
        f"QUANTITY=COLUMNS as position=2-7,effort=8-13, of {', '.join(QUANTITIES)}, or rate=HZ",
    )
    columns = dict[str, list[str]]()
    for quantity, names in found.items():
        spans = [re.fullmatch(r"(\d+)-(\d+)", name) for name in names.split(",")]
        columns[quantity] = [
            str(k)
            for span, name in zip(spans, names.split(","), strict=True)
            for k in (range(int(span[1]), int(span[2]) + 1) if span else [name.strip()])
        ]
    return columns, float(rate[0]) if rate and "rate" in parts else None


def named_columns(
    scanned: Sequence[TableColumn], given: Mapping[str, Sequence[str]], place: Location
) -> list[TableColumn]:
    """Return columns with names of the quantities `given`; of others only times keep their names.

    Parameters
    ----------
    scanned : all columns of the table.
    given : names or numbers of the columns by quantity, as `split_columns` returns them.
    place : the table, for errors.

    Raises
    ------
    BadInputError : the table does not have these columns.
    """
    names = {
        c.key: c.name * ("time" in map(KIND.get, TOKEN.findall(c.name.lower()))) for c in scanned
    }
    for quantity, wanted in given.items():
        keys: list[str | int] = []
        for name in wanted:
            found = [
                c.key
                for k, c in enumerate(scanned, 1)
                if name in (str(k), str(c.key), str(c.key).partition("(")[0]) and not c.texts
            ]
            place.require(
                found, f"column {name}", text="no column of numbers has this name or number"
            )
            keys += found
        meaning = quantity.replace("reference", "reference position")
        units = {c.key: unit[0] for c in scanned if (unit := UNIT.search(c.name))}
        names |= {
            key: f"{GIVEN} {meaning} {k} {units.get(key, '')}" for k, key in enumerate(keys, 1)
        }
    return [replace(c, name=names[c.key]) for c in scanned]


def effort_unit(name: str) -> str:
    """Return the unit of efforts with this name, as `Nm`; refuse others."""
    unit = UNITS.get(name.lower(), name)
    COMMAND_LINE.require(
        unit in EFFORT_UNITS, "effort_unit", name, f"one of {', '.join(EFFORT_UNITS)}"
    )
    return unit


def complete_map(
    text: str,
    answers: Mapping[str, tuple[Sequence[str], str]],
    rate_hz: float | None,
    *,
    geared: bool,
) -> tuple[str, list[str]]:
    """Complete a map that `propose_map` made.

    Positions are those of the joints unless names say otherwise. Torques and forces are those of
    the joints unless they are `geared`. A reference that is not clear is left out.

    Parameters
    ----------
    text : the proposed map.
    answers : units by `position_unit` and `effort_unit`, one or one per column, with the reason.
    rate_hz : sample rate, Hz, in place of `[time]`; None if the table has times.
    geared : whether torques and forces are those of motors with ratios.

    Returns
    -------
    The map, and the names of the answers that it still needs.

    Raises
    ------
    BadInputError : an answer differs from what the table shows.
    """
    text = re.sub(
        rf'(?m)^\[reference\]\ncolumns = \["{FILL_IN}"\](.*)\n(?:[^\[\n].*\n)*',
        r"# no [reference]:\1\n",
        text,
    )
    if rate_hz is not None:
        text = re.sub(r"(?m)^(\[time\]\n(?:[^\[\n].*\n)*|sample_rate_hz.*\n)", "", text)
        first, rest = text.split("\n", 1)
        text = f"{first}\nsample_rate_hz = {rate_hz:.12g} # as given\n{rest}"
    missing, lines, table, effort = dict[str, None](), [], "", ""
    for line in text.splitlines():
        table = line.strip("[]") if line.startswith("[") else table
        key = f"{table}.{line.partition(' ')[0]}".lstrip(".")
        name, per = _ANSWERS.get(key, ("", ""))
        units, why = answers.get(name, ((), ""))
        values = [f"{unit}{per}" for unit in units]
        value = json.dumps(values[0] if len(values) == 1 else values, ensure_ascii=False)
        if FILL_IN not in line or line.startswith("#"):
            COMMAND_LINE.require(
                value in line or not units or key not in ("position.unit", "effort.unit"),
                name,
                text=f"the table shows {line.removeprefix('unit = ')}",
                advice="Omit the option",
            )
        elif key == "effort.side":
            side = "motor" if geared or not re.search('"m?N', effort) else "joint"
            line = f'side = "{side}" # by the unit and the ratios'
        elif units:
            line = f'side = "joint" # {why}' if key.endswith(".side") else f"unit = {value} # {why}"
        else:
            missing[name] = None
        effort = line if key == "effort.unit" else effort
        lines.append(line)
    return "\n".join([*lines, ""]), [*missing]
