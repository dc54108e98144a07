"""Proposal of the map.toml of a table, by its header and first rows.

`FILL IN` marks what is open.
"""

import json
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import Location, listed
from ..files import TableColumn, read_columns, scan_table
from ..robot import FILL_IN, Robot
from .column_words import (
    AT_JOINT,
    EFFORTS,
    FRANKA,
    GIVEN,
    GLUED,
    KIND,
    MAKERS,
    TOKEN,
    UNIT,
    UNITS,
    UR,
)
from .completed_map import named_columns
from .quantities import TIME_UNITS, TURN, turn_jumps
from .stamps import bursts
from .time_base import roundest, roundest_rate_hz

_UNWRAP = "\nunwrap = true # angles jump by a turn"
TORQUE_SENSORS = "joint torque sensors"
RAD_OR_DEG = "rad or deg?"
ROWS = 1000  # rows that the proposal reads
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 12_000.0  # usual rates of tables
# Larger positions are those of a motor, or counts.
MAX_TURN_DEG = 720.0
# In a column of times without a name, this share of the steps deviates by less than this part.
MAX_UNEVEN, MIN_EVEN = 0.1, 0.9
MIN_MOTION = 1e-2  # smallest motion of a position, in any unit


@dataclass(frozen=True, kw_only=True)
class _Column(TableColumn):
    """A column of a table, with the parts of its name.

    Attributes:
        words: known words of the name by kind.
        label: other parts of the name: a joint's number or name.
        unit: unit in the name; None without one.
        joint: joint to which a column of names assigns its number.
    """

    words: dict[str, str]
    label: tuple[str, ...]
    unit: str | None
    joint: str = ""


Groups = dict[tuple[str, str], list[_Column] | str]


def propose_map(
    table: Path, robot: Robot | None, given: Mapping[str, Sequence[str]] | None = None
) -> str:
    """Propose the text of a map.toml for a CSV or MAT table, with the reason of each line.

    Columns are identified by words of several languages and tools, with the joint's number or its
    name in `robot`, in the header or in cells. Columns without names are listed. Unit and side of
    efforts are those of the maker's format, or given in the header. `effort_timing` is never set.

    Parameters
    ----------
    table : the file.
    robot : the robot, if known.
    given : names of columns, or numbers from 1, by `time` or quantity; other columns then have no
        quantity.

    Raises
    ------
    BadInputError : this is not a table, each of its rows belongs to one joint, or it does not have
        the columns `given`.
    """
    scanned, place = scan_table(table, ROWS), Location(str(table))
    maker = next((m for m, x in MAKERS.items() if any(re.search(x, c.name) for c in scanned)), "")
    if given:
        scanned = named_columns(scanned, given, place)
    columns = _columns(scanned, maker, robot, place)
    groups = _groups(columns, robot)
    position, why = _only(groups, ["position"])
    size = len(position)
    effort, why_effort = _only(groups, EFFORTS, size)
    time, time_s = _time(table, columns)
    turn, side = _turn(table, position), _side(position, robot, maker)
    unit = _position_unit(position, robot, maker, turn)
    lines = [
        f"# Proposed by robot-acquire import for {table.name}. {FILL_IN} marks what the table does "
        "not show.",
        *([] if any(c.name for c in scanned) else _ranges(table, columns, scanned)),
        *time,
        "[position]",
        _listed(position, why),
        unit,
        side + _UNWRAP * bool(turn),
    ]
    reference, why = _only(groups, ["position"], size, "reference")
    q, turn = _values(position, turn), _turn(table, reference)
    if reference and position and not _moves_as(_values(reference, turn), q):
        why = f"is it a reference? It does not follow the position: {_keys(reference)}"
        reference, why = [], why if "position" in reference[0].words else ""
    if reference or why:
        lines += [
            "[reference]",
            _listed(reference, why),
            _stated(reference, unit),
            side + _UNWRAP * bool(turn),
        ]
    velocity, why = _only(groups, ["velocity"], size)
    if velocity and position and ("motor" in velocity[0].words) == ("motor" in position[0].words):
        path = (
            _values(velocity)
            if time_s is None
            else np.cumsum(_values(velocity).T * np.gradient(time_s), axis=1).T
        )
        if velocity[0].unit or time_s is None or _moves_as(path, q):
            per_s = re.sub(
                r'"(rad|deg|m|mm)"',
                r'"\1/s"',
                re.sub("(?<=#).*Values.*|rad, deg.*", " rad/s, rpm, ...", unit),
            )
            lines += ["[velocity]", _listed(velocity, why), _stated(velocity, per_s), side]
        else:
            why = f"not the derivative of the position: {_keys(velocity)}"
    lines += [
        *([f"# no [velocity]: {why}"] if why else []),
        "[effort]",
        _listed(effort, why_effort),
        *_effort_lines(effort, maker),
    ]
    return "\n".join([*lines, ""])


def _values(columns: Sequence[_Column], turn: float = 0.0) -> Array:
    """Return the first rows (N, n), without jumps by a `turn`."""
    x = np.column_stack([c.x for c in columns]) if columns else np.empty((1, 0))
    return np.unwrap(x, axis=0, period=turn) if turn else x


def _columns(
    scanned: Sequence[TableColumn], maker: str, robot: Robot | None, place: Location
) -> list[_Column]:
    """Return the columns with numbers.

    In libfranka's logs the state is used, not the command, and the joint, not the motor. Columns of
    joint names that change between rows are refused.
    """
    joints = {joint.name for joint in robot.joints} if robot else set()
    found: list[_Column] = []
    told: dict[tuple[str, ...], str] = {}
    for k, column in enumerate(scanned):
        text = "".join(
            c for c in unicodedata.normalize("NFKD", column.name) if not unicodedata.combining(c)
        )
        stated = UNIT.search(text)
        text = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", UNIT.sub(" ", text))
        text = re.sub("|".join(word for word in KIND if not word.isascii()), r" \g<0> ", text)
        text = GLUED.sub(r"\1 \2", text)
        tokens = [token.lower() for token in TOKEN.findall(text)]
        words = {KIND[token]: token for token in tokens if token in KIND}
        label = tuple(token for token in tokens if token not in KIND)
        named = "name" in words or {*words} in ({"joint"}, {"motor"})
        if joints & {*column.texts} or (column.texts and named and "".join(label or "0").isdigit()):
            told[label] = column.texts[0]
            place.require(
                len(column.texts) <= 1,
                f"column {column.key}",
                ", ".join(column.texts[:3]),
                text="the joint names change between rows",
                advice="Give each joint a column of its own, or rename a column of other names",
            )
        if "current" in words and {"position", "velocity"} & {*words}:
            # The current position is the measured one, not a current.
            words["measured"] = words.pop("current")
        other = maker == FRANKA and (
            {"cmd", "theta"} & {*tokens} or column.name in [c.name for c in scanned[:k]]
        )
        if not (other or np.isnan(column.x).any()):
            unit = stated and re.sub("[·_]", "", stated[stated.lastindex or 0].strip().lower())
            found.append(_Column(**vars(column), words=words, label=label, unit=unit))
    place.require(found, text="the table has no columns of numbers")
    return [replace(c, joint=told.get(c.label, "")) for c in found]


def _groups(columns: Sequence[_Column], robot: Robot | None) -> Groups:
    """Group columns, one per joint, by quantity and source (and motor side).

    An ambiguous group is a text.
    """
    members: dict[tuple[str, str], list[_Column]] = {}
    for c in columns:
        quantities = [kind for kind in ("position", "velocity", *EFFORTS) if kind in c.words]
        sources = [source for source in ("reference", "measured") if source in c.words]
        if len(quantities) == 1 and len(sources) < 2:
            source = "".join(sources) + " motor" * ("motor" in c.words)
            members.setdefault((quantities[0], source), []).append(c)
    all_labels = [{*c.label} for group in members.values() for c in group]
    common = (
        {x for x in set.intersection(*all_labels) if not x.isdigit()}
        if len(all_labels) > 1
        else set()
    )
    found = {
        key: found
        for key, group in members.items()
        if (found := _one_per_joint(group, common, robot))
    }
    # Columns such as `ref1` are references of positions if they have no rival.
    bare = [c for c in columns if "reference" in c.words and {*c.words} <= {"reference", "joint"}]
    if bare and isinstance(named := _one_per_joint(bare, common, robot), list):
        found.setdefault(("position", "reference"), named)
    return found


def _one_per_joint(
    group: Sequence[_Column], common: set[str], robot: Robot | None
) -> list[_Column] | str:
    """Select a column for each joint in order, by number or by the names in `robot`.

    The result is a text if they are ambiguous.
    """
    if told := {c.joint: c for c in group if c.joint}:
        joints = [joint.name for joint in robot.joints] if robot else [""]
        if len(told) == len(group) and {*joints} <= {*told}:
            return [told[joint] for joint in joints]
        return f"the joints of robot.toml in their order? {_keys(group)} are {', '.join(told)}"
    labels = [tuple(x for x in c.label if x not in common) for c in group]
    by_label = dict(zip(labels, group, strict=True))
    names = [
        tuple(x for x in TOKEN.findall(joint.name.lower()) if x not in KIND and x not in common)
        for joint in (robot.joints if robot else ())
    ]
    by_name = names and {*names} <= {*labels} and len({*names}) == len(names)
    numbered: list[tuple[str, ...]] = sorted(
        (x for x in by_label if len(x) == 1 and x[0].isdigit()), key=lambda x: int(x[0])
    )
    chosen: list[tuple[str, ...]] = (
        names if by_name else numbered or [x for x in labels if labels == [()]]
    )
    span = int(numbered[-1][0]) - int(numbered[0][0]) + 1 if numbered else 0
    keys, several = _keys(group), all(labels) and len(by_label) > 1
    return _first(
        (not chosen, f"which columns, in the order of the joints? {keys}" if several else ""),
        (not by_name and span != len(numbered), f"numbers are missing: {keys}"),
        (any(labels.count(label) > 1 for label in chosen), f"a number occurs twice: {keys}"),
        (
            robot and len(chosen) != robot.n,
            f"{robot and robot.n} joints in robot.toml, and {len(chosen)} columns: {keys}",
        ),
        (True, ""),
    ) or [by_label[label] for label in chosen]


def _only(
    groups: Groups, kinds: Sequence[str], size: int = 0, source: str = "measured"
) -> tuple[list[_Column], str]:
    """Return the only group of these kinds that is measured or has no source.

    If there is no such group, the text is the reason. `size` is the number of position columns.
    """
    found = [
        group
        for (kind, own), group in groups.items()
        if kind in kinds and own.removesuffix(" motor") in (source, source.replace("measured", ""))
    ]
    fits = [x for x in found if isinstance(x, list) and len(x) == (size or len(x))]
    why = " or ".join(x if isinstance(x, str) else _keys(x) for x in fits or found)
    return (fits[0], "") if len(fits) == 1 else ([], why)


def _keys(columns: Sequence[_Column]) -> str:
    return json.dumps([c.key for c in columns], ensure_ascii=False)


def _ranges(table: Path, columns: Sequence[_Column], scanned: Sequence[TableColumn]) -> list[str]:
    """List the columns as comments, with their ranges or texts."""
    x = read_columns(table, [c.key for c in columns], len(columns))
    ranges = {
        c.key: f"{low:.10g} to {high:.10g}"
        for c, low, high in zip(columns, x.min(axis=0), x.max(axis=0), strict=True)
    }
    return [
        "# Columns, counted from 1:",
        *(f"#   {c.key}: {ranges.get(c.key) or listed(c.texts)}" for c in scanned),
    ]


def _turn(table: Path, columns: Sequence[_Column]) -> float:
    """Return the turn in rad or degrees by which angles of the columns jump; 0 if none does."""
    x = read_columns(table, [c.key for c in columns], len(columns)) if columns else np.empty((1, 0))
    return next((turn for turn in (TURN, 360.0) if turn_jumps(x, turn).any()), 0.0)


def _listed(columns: Sequence[_Column], why: str) -> str:
    if not columns:
        return f'columns = ["{FILL_IN}"] # {why or "no column has a matching name"}'
    words = dict.fromkeys(word for c in columns for kind, word in c.words.items() if kind)
    why = "as given" if GIVEN in words else f"from the names: {', '.join(words)}"
    return f"columns = {_keys(columns)} # {why}"


def _first(*rules: tuple[object, str]) -> str:
    """Return the text of the first rule that is true."""
    return next(text for holds, text in rules if holds)


def _stated(columns: Sequence[_Column], otherwise: str) -> str:
    """Return the unit that the header gives for all columns, or the line `otherwise`."""
    units = sorted({str(c.unit) for c in columns})
    known = {UNITS.get(unit) for unit in units}
    return _first(
        ({*units} <= {"None"}, otherwise),
        (
            len(known) > 1 or None in known,
            f'unit = "{FILL_IN}" # the header has {", ".join(units)}',
        ),
        (True, f'unit = "{next(iter(known), "")}" # from the header'),
    )


def _position_unit(columns: Sequence[_Column], robot: Robot | None, maker: str, turn: float) -> str:
    types = [joint.position_unit for joint in robot.joints] if robot else ["rad"]
    largest = float(np.abs(_values(columns)).max(initial=0.0))
    each = f"; one for each: {json.dumps(types)}" if len(set(types)) > 1 else ""
    at_joint = columns and "m" not in types and '"joint"' in _side(columns, robot, maker)
    return _stated(
        columns,
        _first(
            (maker, f"unit = {json.dumps(types if 'm' in types else 'rad')} # {maker}"),
            (
                turn and "m" not in types,
                f'unit = "{"deg" if turn == 360 else "rad"}" # angles jump by {turn:.4g}',
            ),
            (not at_joint, f'unit = "{FILL_IN}" # rad, deg, m, ...{each}'),
            (
                2 * np.pi < largest <= MAX_TURN_DEG,
                f'unit = "deg" # values up to {largest:.4g} exceed 2 pi',
            ),
            (True, f'unit = "{FILL_IN}" # {RAD_OR_DEG} Values are up to {largest:.4g}'),
        ),
    )


def _side(columns: Sequence[_Column], robot: Robot | None, maker: str) -> str:
    words = {word for c in columns for pair in c.words.items() for word in pair}
    return _first(
        ("motor" in words, 'side = "motor" # from the names'),
        (maker or words & {"joint", *AT_JOINT}, f'side = "joint" # {maker or "from the names"}'),
        (
            robot and np.array_equal(robot.R, np.eye(robot.n)),
            'side = "joint" # robot.toml has no ratios',
        ),
        (True, f'side = "{FILL_IN}" # motor or joint'),
    )


def _effort_lines(columns: Sequence[_Column], maker: str) -> list[str]:
    kinds = {kind for c in columns for kind in c.words}
    ur, franka = maker == UR and "current" in kinds, maker == FRANKA and "torque" in kinds
    unit = _first(
        (ur, 'unit = "A" # UR RTDE'),
        (franka, 'unit = "N m" # libfranka'),
        (True, _stated(columns, f'unit = "{FILL_IN}" # N m, A, mA, %, ... see the manual')),
    )
    of_motors = re.match(r'unit = "(m?[AV]|%|per mille|‰)"', unit) or "current" in kinds
    return [
        unit,
        _first(
            (ur, 'side = "motor" # UR RTDE: currents of the motors'),
            (franka, f'side = "joint" # libfranka: {TORQUE_SENSORS}'),
            (of_motors, 'side = "motor" # currents, voltages and percentages are of motors'),
            (True, f'side = "{FILL_IN}" # motor or joint'),
        ),
    ]


def _time(table: Path, columns: Sequence[_Column]) -> tuple[list[str], Array | None]:
    """Propose `[time]`, or a rate to fill in; also return the times of the first rows in s."""
    growing = [c for c in columns if len(c.x) > 1 and (np.diff(c.x) >= 0).all() and bursts(c.x)[0]]
    found = [
        c
        for c in growing
        if "time" in c.words and not {*c.words} & {"position", "velocity", *EFFORTS}
    ]
    found = [c for c in found if not c.label] or found
    found = [c for c in found if c.words.get("") == "header"] or found
    found = found or [
        c
        for c in growing
        # Without a name, a column that grows by 1 is a counter, not a time.
        if not c.name
        and (steps := np.diff(read_columns(table, [c.key], 1)[:, 0])).min() > 0
        and (typical := np.median(steps)) != 1
        and np.mean(np.abs(steps / typical - 1) < MAX_UNEVEN) > MIN_EVEN
    ]
    found = found[:1] if all(np.array_equal(c.x, found[0].x) for c in found) else found
    if len(found) != 1:
        return [
            f'sample_rate_hz = "{FILL_IN}" # or [time]: '
            f"{_keys(found) if found else 'no column of times'}"
        ], None
    column, period = found[0], bursts(found[0].x)[0]
    stated = [unit for unit in TIME_UNITS if unit == UNITS.get(column.unit or "")]
    fits = stated or [
        u for u, s in TIME_UNITS.items() if MIN_RATE_HZ <= 1 / (period * s) <= MAX_RATE_HZ
    ]
    lines = ["[time]", f"column = {_keys(found)[1:-1]} # grows by {period:.6g}"]
    if len(fits) != 1:
        return [*lines, f'unit = "{FILL_IN}" # s, ms, us or ns'], None
    rate_hz = 1 / (period * TIME_UNITS[fits[0]])
    lines.append(
        f'unit = "{fits[0]}" # the rate is then {rate_hz:.6g} '
        f"Hz{', from the header' * bool(stated)}"
    )
    time_s = read_columns(table, [column.key], 1)[:, 0] * TIME_UNITS[fits[0]]
    steps, (step_s, between_s) = np.diff(time_s), bursts(time_s)
    if (np.abs(steps * rate_hz - 1) > 0.1).any():
        grid_hz, why = roundest_rate_hz(time_s[np.append(True, steps > 0)]), "the steps are uneven"
        # The rounding stays within the drift that an import accepts.
        if between_s:
            grid_hz = roundest(1 / step_s, between_s / (time_s[-1] - time_s[0]) / 8)
            why = "timestamps come in bursts"
        lines.append(f"resample_hz = {grid_hz:.12g} # {why}")
    return lines, column.x * TIME_UNITS[fits[0]]


def _moves_as(x: Array, q: Array) -> bool:
    """Test whether changes of x (N, n) are those of q within a factor of 2.

    It is true if nothing moves: a table may begin at rest.
    """
    x, q = x - x.mean(axis=0), q - q.mean(axis=0)
    return bool(np.abs(q).max() < MIN_MOTION or 0.5 < (x * q).sum() / max((x**2).sum(), 1e-300) < 2)
