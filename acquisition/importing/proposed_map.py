"""Proposes the map.toml of a CSV table by its header and first rows; `FILL IN` marks
what these do not say.
"""

import json
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..files import read_columns, read_csv_head
from ..robot import FILL_IN, Robot
from .quantities import POSITION_UNITS, VELOCITY_UNITS
from .tables import TIME_UNITS
from .time_base import roundest_rate_hz

TORQUE_SENSORS = "torque sensors behind the gears"
ROWS = 1000  # that the proposal looks at
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 12_000.0  # of a table
MAX_TURN_DEG = 720.0  # of a joint; positions beyond it are a motor's, or counts
MIN_MOTION = 1e-2  # of a position that moves, in any unit
_WORDS = {
    "position": "q qpos jpos pos posn position positions angle angles theta winkel lage stellung "
    "posizione angolo "
    "posicion angulo posicao 位置 角度",
    "velocity": "dq qd qdot qvel jvel vel velo velocity velocities speed speeds omega "
    "geschwindigkeit "
    "drehzahl vitesse "
    "velocita velocidad velocidade 速度",
    "torque": "tau torque torques trq moment drehmoment couple coppia par 力矩 扭矩 转矩 トルク",
    "current": "current currents curr strom motorstrom courant corrente corriente 电流 電流",
    "effort": "eff effort efforts",
    "reference": "ref reference references set setpoint setpoints target targets tgt cmd command "
    "commanded des desired d soll "
    "goal consigne consigna riferimento referencia 目标 目標 指令 期望 给定",
    "measured": "act actual ist istwert feedback fb fbk meas measured msr present mesure mesuree "
    "reale "
    "real 实际 実際",
    "time": "t time timestamp stamp zeit temps tiempo tempo duration 时间 時間",
    "motor": "m motor motors mot moteur motore encoder enc 电机",
    "joint": "joint joints j axis axes axe achse gelenk asse eje articulation 关节 関節 轴",
    "": "a state states robot data value values controller trajectory nc to plc field header",
}
_KIND = {word: kind for kind, words in _WORDS.items() for word in words.split()}
_AT_JOINT = {"q", "qpos", "jpos", "angle", "angles", "theta", "winkel", "angolo", "angulo", "角度"}
_EFFORTS = ("torque", "current", "effort")
_UR, _FRANKA = "UR RTDE", "libfranka"
_ROS = r"joint_states|controller_state|(feedback|reference|actual|desired)[./]positions"
# By names that no other has.
_MAKERS = {_UR: r"^actual_q_\d", _FRANKA: r"(^|\.)tau_J[\[_]\d", "ROS, REP 103": _ROS}
_UNITS = {unit: unit for unit in (*POSITION_UNITS, *VELOCITY_UNITS, *TIME_UNITS, "%")}
_UNITS |= {
    "radian": "rad",
    "radians": "rad",
    "degree": "deg",
    "degrees": "deg",
    "°": "deg",
    "u/min": "rpm",
    "n": "N",
    "rads": "rad/s",
    "degs": "deg/s",
    "degps": "deg/s",
    "°/s": "deg/s",
    "\u03bcs": "us",
    "a": "A",
    "ma": "mA",
    "v": "V",
    "nm": "N m",
    "n*m": "N m",
    "mnm": "mN m",
    "‰": "per mille",
}
_TOKEN = re.compile(r"[^\W\d_]+|\d+")
_UNIT = re.compile(  # in brackets, or a word
    r"[\[(]([^\])\d]+)[\])]|(?<![a-z])(rad_?p?s|deg_?p?s|rad|deg|rpm|n_?m|ma|ms|us|ns|mm)(?![a-z])",
    re.IGNORECASE,
)


@dataclass(frozen=True, kw_only=True)
class _Column:
    """A column: how a map names it, its words by kind, what else its name has (a joint's number or
    name), its stated unit.
    """

    key: str | int
    words: dict[str, str]
    label: tuple[str, ...]
    unit: str | None
    x: Array


Groups = dict[tuple[str, str], list[_Column] | str]


def propose_map(table: Path, robot: Robot | None) -> str:
    """The text of a map.toml for a CSV table, with the reason of each line.

    `effort_timing` is never set.

    Columns go by words of several languages and tools, with the joint's number or its name in
    `robot`. Unit and side of efforts are those of the maker's format, or stated in the header.
    Raises `BadInputError`: no table.
    """
    names, has_header, values = read_csv_head(table, ROWS)
    maker = next(
        (
            maker
            for maker, pattern in _MAKERS.items()
            if any(re.search(pattern, name) for name in names)
        ),
        "",
    )
    columns = _columns(names if has_header else [""] * len(names), values, maker)
    groups = _groups(columns, robot)
    position, why = _only(groups, ["position"])
    size = len(position)
    effort, why_effort = _only(groups, _EFFORTS, size)
    time, time_s = _time(table, columns)
    unit, side = _position_unit(position, robot, maker), _side(position, robot, maker)
    lines = [
        f"# Proposed by robot-acquire import for {table.name}. {FILL_IN} marks what the table does "
        "not say.",
        *time,
        "[position]",
        _listed(position, why),
        unit,
        side,
    ]
    reference, why = _only(groups, ["position"], size, "reference")
    q = _values(position)
    if reference and position and not _moves_as(_values(reference), q):
        reference, why = (
            [],
            f"is it a reference? It does not move as the position: {_keys(reference)}",
        )
    if reference or why:
        lines += ["[reference]", _listed(reference, why), _stated(reference, unit), side]
    velocity, why = _only(groups, ["velocity"], size)
    if velocity and position and ("motor" in velocity[0].words) == ("motor" in position[0].words):
        path = (
            _values(velocity)
            if time_s is None
            else np.cumsum(_values(velocity).T * np.gradient(time_s), axis=1).T
        )
        if velocity[0].unit or time_s is None or _moves_as(path, q):
            per_s = re.sub("(?<=#).*Values.*|rad, deg.*", " rad/s, rpm, ...", unit)
            per_s = re.sub(r'"(rad|deg|m|mm)"', r'"\1/s"', per_s)
            lines += ["[velocity]", _listed(velocity, why), _stated(velocity, per_s), side]
        else:
            why = f"not the derivative of the position: {_keys(velocity)}"
    lines += [f"# no [velocity]: {why}"] if why else []
    lines += ["[effort]", _listed(effort, why_effort), *_effort_lines(effort, maker)]
    return "\n".join([*lines, ""])


def _values(columns: Sequence[_Column]) -> Array:
    return np.column_stack([c.x for c in columns]) if columns else np.empty((0, 0))


def _columns(names: list[str], values: Array, maker: str) -> list[_Column]:
    """The columns that hold numbers.

    Of libfranka's state and command the state, of its motor and joint the joint.
    """
    found: list[_Column] = []
    for k, name in enumerate(names):
        text = "".join(
            c for c in unicodedata.normalize("NFKD", name) if not unicodedata.combining(c)
        )
        stated = _UNIT.search(text)
        unit = (
            None
            if stated is None
            else (stated[1] or stated[2]).strip().lower().replace("·", "").replace("_", "")
        )
        text = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", _UNIT.sub(" ", text))
        text = re.sub("|".join(word for word in _KIND if not word.isascii()), r" \g<0> ", text)
        tokens = [token.lower() for token in _TOKEN.findall(text)]
        other = maker == _FRANKA and ({"cmd", "theta"} & {*tokens} or name in names[:k])
        if other or np.isnan(values[:, k]).any():
            continue
        words = {_KIND[token]: token for token in tokens if token in _KIND}
        if "current" in words and {"position", "velocity"} & {*words}:
            words["measured"] = words.pop("current")  # the current position, of now
        found.append(
            _Column(
                key=name if name and names.count(name) == 1 else k + 1,
                words=words,
                label=tuple(token for token in tokens if token not in _KIND),
                unit=unit,
                x=values[:, k],
            )
        )
    return found


def _groups(columns: Sequence[_Column], robot: Robot | None) -> Groups:
    """Columns of one per joint by quantity and source (and the motor's side); a text
    if they are ambiguous.
    """
    kinds = ("position", "velocity", *_EFFORTS)
    members: dict[tuple[str, str], list[_Column]] = {}
    for c in columns:
        quantities = [kind for kind in kinds if kind in c.words]
        if len(quantities) == 1 and not {"reference", "measured"} <= {*c.words}:
            source = (
                "reference"
                if "reference" in c.words
                else "measured"
                if "measured" in c.words
                else ""
            )
            members.setdefault(
                (quantities[0], source + " motor" * ("motor" in c.words)), []
            ).append(c)
    all_labels = [{*c.label} for group in members.values() for c in group]
    common = (
        {x for x in set.intersection(*all_labels) if not x.isdigit()}
        if len(all_labels) > 1
        else set()
    )
    return {
        key: found
        for key, group in members.items()
        if (found := _one_per_joint(group, common, robot))
    }


def _one_per_joint(
    group: Sequence[_Column], common: set[str], robot: Robot | None
) -> list[_Column] | str:
    """A column for each joint in order, by number or by the names in `robot`; a text
    if they are ambiguous.
    """
    labels = [tuple(x for x in c.label if x not in common) for c in group]
    by_label = dict(zip(labels, group, strict=True))
    words = [_TOKEN.findall(joint.name.lower()) for joint in robot.joints] if robot else []
    names = [tuple(x for x in name if x not in _KIND and x not in common) for name in words]
    numbered: list[tuple[str, ...]] = [x for x in by_label if len(x) == 1 and x[0].isdigit()]
    chosen = sorted(numbered, key=lambda x: int(x[0]))
    if names and {*names} <= {*labels} and len({*names}) == len(names):
        chosen = names
    elif not chosen and labels != [()]:
        several = all(labels) and len(by_label) > 1
        return f"which columns, in the order of the joints? {_keys(group)}" if several else ""
    elif chosen and int(chosen[-1][0]) - int(chosen[0][0]) != len(chosen) - 1:
        return f"numbers are missing: {_keys(group)}"
    chosen = chosen or labels
    if any(labels.count(label) > 1 for label in chosen):
        return f"a number is there twice: {_keys(group)}"
    if robot and len(chosen) != robot.n:
        return f"{robot.n} joints in robot.toml, and {len(chosen)} columns: {_keys(group)}"
    return [by_label[label] for label in chosen]


def _only(
    groups: Groups, kinds: Sequence[str], size: int = 0, source: str = "measured"
) -> tuple[list[_Column], str]:
    """The only group of these kinds that is measured or does not say so, else why there is none;
    `size`: of the position.
    """
    sources = {source, source.replace("measured", "")}
    found = [
        group
        for key, group in groups.items()
        if key[0] in kinds and key[1].removesuffix(" motor") in sources
    ]
    fits = [x for x in found if isinstance(x, list) and len(x) == (size or len(x))]
    if len(fits) == 1:
        return fits[0], ""
    return [], " or ".join(x if isinstance(x, str) else _keys(x) for x in fits or found)


def _keys(columns: Sequence[_Column]) -> str:
    return json.dumps([c.key for c in columns], ensure_ascii=False)


def _listed(columns: Sequence[_Column], why: str) -> str:
    if not columns:
        return f'columns = ["{FILL_IN}"] # {why or "no names that say it"}'
    words = dict.fromkeys(word for c in columns for kind, word in c.words.items() if kind)
    return f"columns = {_keys(columns)} # by the names: {', '.join(words)}"


def _stated(columns: Sequence[_Column], otherwise: str) -> str:
    """The unit that the header states for all columns, or the line `otherwise`."""
    units = {c.unit for c in columns}
    if units <= {None}:
        return otherwise
    known = [_UNITS.get(unit or "") for unit in units]
    if len(known) > 1 or known[0] is None:
        return (
            f'unit = "{FILL_IN}" # the header says {", ".join(sorted(str(unit) for unit in units))}'
        )
    return f'unit = "{known[0]}" # the header says so'


def _position_unit(columns: Sequence[_Column], robot: Robot | None, maker: str) -> str:
    types = [joint.position_unit for joint in robot.joints] if robot else ["rad"]
    largest = float(np.abs(_values(columns)).max(initial=0.0))
    if maker:
        line = f"unit = {json.dumps(types if 'm' in types else 'rad')} # {maker}"
    elif not columns or "m" in types or '"joint"' not in _side(columns, robot, maker):
        each = f"; one for each: {json.dumps(types)}" if len(set(types)) > 1 else ""
        line = f'unit = "{FILL_IN}" # rad, deg, m, ...{each}'
    elif 2 * np.pi < largest <= MAX_TURN_DEG:
        line = f'unit = "deg" # values to {largest:.4g} are beyond 2 pi'
    else:
        line = f'unit = "{FILL_IN}" # rad or deg? Values to {largest:.4g}'
    return _stated(columns, line)


def _side(columns: Sequence[_Column], robot: Robot | None, maker: str) -> str:
    words = {word for c in columns for pair in c.words.items() for word in pair}
    if "motor" in words:
        return 'side = "motor" # by the names'
    if maker or words & {"joint", *_AT_JOINT}:
        return f'side = "joint" # {maker or "by the names"}'
    if robot and np.array_equal(robot.R, np.eye(robot.n)):
        return 'side = "joint" # robot.toml has no ratios'
    return f'side = "{FILL_IN}" # motor or joint'


def _effort_lines(columns: Sequence[_Column], maker: str) -> list[str]:
    kinds = {kind for c in columns for kind in c.words}
    if maker == _UR and "current" in kinds:
        return ['unit = "A" # UR RTDE', 'side = "motor" # UR RTDE: of the joints\' motors']
    if maker == _FRANKA and "torque" in kinds:
        return ['unit = "N m" # libfranka', f'side = "joint" # libfranka: {TORQUE_SENSORS}']
    unit = _stated(columns, f'unit = "{FILL_IN}" # N m, A, mA, %, ... as the manual says')
    if re.match(r'unit = "(m?[AV]|%|per mille)"', unit) or "current" in kinds:
        return [unit, 'side = "motor" # as all currents, voltages and percentages of a rating']
    return [unit, f'side = "{FILL_IN}" # motor or joint']


def _time(table: Path, columns: Sequence[_Column]) -> tuple[list[str], Array | None]:
    """`[time]`, or a rate to be filled in; the times of the first rows in s."""
    found = [
        c
        for c in columns
        if "time" in c.words
        and not {*c.words} & {"position", "velocity", *_EFFORTS}
        and (steps := np.diff(c.x)).size
        and (steps >= 0).all()
        and np.median(steps) > 0
    ]
    found = [c for c in found if not c.label] or found
    found = found[:1] if all(np.array_equal(c.x, found[0].x) for c in found) else found
    if len(found) != 1:
        return [
            f'sample_rate_hz = "{FILL_IN}" # or [time]: '
            f"{_keys(found) if found else 'no column of times'}"
        ], None
    column, period = found[0], float(np.median(np.diff(found[0].x)))
    stated = [unit for unit in TIME_UNITS if unit == _UNITS.get(column.unit or "")]
    fits = stated or [
        u for u, s in TIME_UNITS.items() if MIN_RATE_HZ <= 1 / (period * s) <= MAX_RATE_HZ
    ]
    lines = [
        "[time]",
        f"column = {json.dumps(column.key, ensure_ascii=False)} # grows by {period:.6g}",
    ]
    if len(fits) != 1:
        return [*lines, f'unit = "{FILL_IN}" # s, ms, us or ns'], None
    rate_hz = 1 / (period * TIME_UNITS[fits[0]])
    lines += [
        f'unit = "{fits[0]}" # the rate is then {rate_hz:.6g} '
        f"Hz{', the header says so' * bool(stated)}"
    ]
    time_s = read_columns(table, [column.key], 1)[:, 0] * TIME_UNITS[fits[0]]
    if (np.abs((steps := np.diff(time_s)) * rate_hz - 1) > 0.1).any():
        lines += [
            f"resample_hz = {roundest_rate_hz(time_s[np.append(True, steps > 0)]):.12g} # the "
            "steps are uneven"
        ]
    return lines, column.x * TIME_UNITS[fits[0]]


def _moves_as(x: Array, q: Array) -> bool:
    """Whether changes of x (N, n) are those of q within a factor of 2; true where nothing moves: a
    table may begin at rest.
    """
    x, q = x - x.mean(axis=0), q - q.mean(axis=0)
    return bool(np.abs(q).max() < MIN_MOTION or 0.5 < (x * q).sum() / max((x**2).sum(), 1e-300) < 2)
