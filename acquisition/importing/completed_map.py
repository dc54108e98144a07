"""A proposed map.toml, completed by what a user knows of the table."""

import json
import re
from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import COMMAND_LINE
from ..robot import FILL_IN, Robot

QUANTITIES = ("time", "position", "velocity", "reference", "effort")
# By key of the map, the answer that completes it, and what follows its unit.
_ANSWERS = {
    "sample_rate_hz": ("columns", ""),
    "time.unit": ("columns", ""),
    "position.columns": ("columns", ""),
    "effort.columns": ("columns", ""),
    "position.unit": ("position_unit", ""),
    "reference.unit": ("position_unit", ""),
    "velocity.unit": ("position_unit", "/s"),
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


def complete_map(
    text: str, answers: Mapping[str, tuple[Sequence[str], str]], rate_hz: float | None, robot: Robot
) -> tuple[str, list[str]]:
    """Complete a map that `propose_map` made.

    Positions are those of the joints, and efforts those of motors with ratios, unless the names or
    the units say otherwise. A reference that is not clear is left out.

    Parameters
    ----------
    text : the proposed map.
    answers : units by `position_unit` and `effort_unit`, one or one per column, with the reason.
    rate_hz : sample rate, Hz, in place of `[time]`; None if the table has times.
    robot : the robot.

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
    side = "joint" if np.array_equal(robot.R, np.eye(robot.n)) else "motor"
    sides = {"position.side": "joint", "reference.side": "joint", "velocity.side": "joint"}
    missing, lines, table = dict[str, None](), [], ""
    for line in text.splitlines():
        table = line.strip("[]") if line.startswith("[") else table
        key = f"{table}.{line.partition(' ')[0]}".lstrip(".")
        name, per = _ANSWERS.get(key, ("", ""))
        units, why = answers.get(name, ((), ""))
        values = [f"{unit}{per}" for unit in units]
        value = json.dumps(values[0] if len(values) == 1 else values, ensure_ascii=False)
        is_open = FILL_IN in line and not line.startswith("#")
        if (
            key.endswith(".unit")
            and values
            and not is_open
            and key in ("position.unit", "effort.unit")
        ):
            COMMAND_LINE.require(
                value in line,
                name,
                text=f"the table shows {line}",
                advice="Omit it, or edit the map",
            )
        elif is_open and key.endswith(".side"):
            line = f'side = "{sides.get(key, side)}" # assumed'
        elif is_open and values:
            line = f"unit = {value} # {why}"
        elif is_open:
            missing[name] = None
        lines.append(line)
    return "\n".join([*lines, ""]), [*missing]
