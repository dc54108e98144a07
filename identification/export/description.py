"""Make a description from a URDF and further values, or correct one: its text, and its robot."""

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.errors import COMMAND_LINE, Location, one_line
from acquisition.robot import FILL_IN, SIMULATED_CONTROLLER, Robot, load_robot, robot_from_files

from ..arrays import Array
from ..model import LINK, InverseModel
from ..report import Cause
from ..trust import DEGREES, Undone, undo
from .chain import Chain, UrdfJoint, read_chain
from .exporting import replace_in_tables

# Uses that a marked line is needed for, after the mark.
TO_FIT, TO_FIT_MOTORS, TO_MOVE = USES = " to fit", " to fit efforts of motors", " to move"
_NO_BUS = f"# {FILL_IN}{TO_MOVE}: [bus] and its drives, which `robot-acquire scan --toml` writes"
_EXAMPLE = "#: "  # starts each line of the example for dry runs with simulated drives
_DEFAULT_EFFORT, _DEFAULT_SPEED = 100.0, 3.0  # of the example, if the URDF has none
# Share of the effort for friction, and for bringing the rotor to full speed in this time.
_EFFORT_SHARE, _RISE_S = 0.02, 0.2
# Of the example's drives: counts per turn or m; rated over maximum effort.
_COUNTS, _RATED_SHARE = 1_000_000, 0.5
OF_GAINS = "A", "V", "%"  # efforts that a drive gain converts to N m or N
# Of the example's SYNC: seven drives fill a bus at 2 ms, and the period has steps of 0.5 ms.
_SYNC_PER_DRIVE_MS, _SHORTEST_SYNC_MS = 0.275, 2.0
_MAX_ROUNDING = 1e-14  # SI: rounding in the sums of a lumped link
_UNCONFIRMED = """Nothing moves before a person has moved each of these joints by hand, compared
# direction, amount and limits, and deleted this key. References that were made before do not apply
# any more. Values at the joint are imported without ratio and zero."""


def robot_of_chain(chain: Chain) -> Robot:
    """Return the robot of the description that `init` writes, with its URDF."""
    return _load_robot(describe(chain, "robot.urdf"), chain)


def read_robot(
    path: Path, joints: Sequence[str] = (), given: Mapping[str, Sequence[float]] | None = None
) -> Robot:
    """Read the robot of a robot.toml, or of a URDF.

    Parameters
    ----------
    path : robot.toml or URDF.
    joints : joints to identify in a URDF, as in `read_chain`.
    given : values that a URDF lacks, as in `Chain.with_values`.

    Raises
    ------
    BadInputError : values are given for a robot.toml, or a file is not valid.
    """
    if path.suffix.lower() in (".urdf", ".xacro", ".xml"):
        return robot_of_chain(read_chain(path, joints).with_values(given or {}))
    for name in (*(["joints"] if joints else []), *(given or {})):
        COMMAND_LINE.refuse(name, text="applies to a URDF only", advice=f"Set it in {path}")
    return load_robot(path)


def chain_of_letters(letters: str) -> Chain:
    """Return joints by their letters, R revolute and P prismatic, without any other values."""
    types = [{"R": "revolute", "P": "prismatic"}.get(letter) for letter in letters.upper()]
    COMMAND_LINE.require(
        types and None not in types,
        "dh",
        letters,
        "one letter per joint, R or P, such as RRPRRR",
    )
    return Chain(
        place="dh",
        name="robot",
        text=b"",
        joints=tuple(
            UrdfJoint(name=f"joint_{j + 1}", type=str(kind)) for j, kind in enumerate(types)
        ),
    )


def describe(chain: Chain, urdf: str, bus: str = "") -> str:
    """Return the text of the robot.toml of a chain.

    Comments with `FILL IN` mark values that the URDF does not have and that are not given. The text
    can be loaded without changes. `[parameters]` has the links' inertials in the frames of
    `InverseModel`, with fixed and locked links lumped into their carrier, damping as Fv and
    friction as Fc; it is left out if a joint moves no mass.

    Parameters
    ----------
    chain : the robot.
    urdf : path of the URDF, relative to the folder of the robot.toml.
    bus : text of `[bus]`, which replaces the example drives.

    Raises
    ------
    BadInputError : the URDF cannot be loaded.
    """
    head = "\n".join(
        [
            *_head(chain, urdf),
            *(line for j in range(len(chain.joints)) for line in _joint(chain, j)),
            *_motors_and_controller(chain),
        ]
    )
    # The drives of the example record the torque at the joint.
    drives = (
        [bus.rstrip()]
        if bus
        else [_NO_BUS]
        if any(joint.ratio or joint.effort_unit in OF_GAINS for joint in chain.joints)
        else [
            f"# {FILL_IN}{TO_MOVE}: the drives. Replace every number by those of the real ones.",
            *(_EXAMPLE + line for line in _drives(chain)),
        ]
    )
    return "\n".join([head, *_parameters(chain, _load_robot(head, chain)), "", *drives, ""])


def describe_rows(chain: Chain, bus: str = "") -> str:
    """Return the text of a robot.toml for a robot without URDF.

    It has rows of modified Denavit–Hartenberg parameters to be filled in.
    """
    rows = f"dh = {{ alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }} # {FILL_IN}{TO_FIT}"
    lines = [
        f"# Made by robot-identify init. {FILL_IN} marks what is not known yet. Angles are in "
        "degrees, all else in SI.",
        f"name = {json.dumps(chain.name)} # {FILL_IN}",
        "gravity_m_s2 = [0, 0, -9.81] # in the base frame",
        *(line for j in range(len(chain.joints)) for line in (*_joint(chain, j), rows)),
        "",
        *_motors_and_controller(chain),
        "",
        bus or f"{_NO_BUS}\n",
    ]
    return "\n".join(lines).replace("the URDF has no ", "the ").replace(": not in a URDF", "")


def _load_robot(text: str, chain: Chain) -> Robot:
    return replace(
        robot_from_files({"robot.toml": text.encode(), "robot.urdf": chain.text}, chain.place),
        name=chain.name,
    )


def _head(chain: Chain, urdf: str) -> list[str]:
    return [
        f"# Made by robot-identify init from {one_line(urdf)}. {FILL_IN} marks what is not in "
        "a URDF.",
        "# Angles are in degrees, all other values in SI.",
        f"# Lines that begin with {_EXAMPLE.strip()} are an example for dry runs; sed -i "
        f"'s/^{_EXAMPLE}//' enables it.",
        f"name = {json.dumps(chain.name)}",
        f"urdf = {json.dumps(urdf, ensure_ascii=False)} # relative to this file",
        "# urdf_meshes = true # store the meshes in recordings, to draw the robot on any machine",
        "gravity_m_s2 = [0, 0, -9.81] # in the URDF's base frame; change it for a robot that "
        "hangs or is tilted",
        *(
            ["", "# Locked at zero, each as a part of the link that carries it:"]
            if chain.locked
            else []
        ),
        *(f"#     {one_line(text)}" for text in chain.locked),
        *(f"# note: {one_line(note)}" for note in chain.notes),
    ]


def _joint(chain: Chain, j: int) -> Iterator[str]:
    joint = chain.joints[j]
    yield from (
        "",
        f"[[joint]] # joint {j + 1}: the names of its parameters end in {j + 1}",
        f"name = {json.dumps(joint.name)}",
        f'type = "{joint.type}"',
    )
    if chain.torque_sensors:
        yield "rotor_inertia = false # torque sensors behind the gears do not measure the rotors"
    length, scale = ("m", 1.0) if joint.type == "prismatic" else ("deg", math.degrees(1.0))
    for key, value, remark in (
        (f"position_{length}", joint.position, "the URDF has no range"),
        (f"speed_{length}_s", joint.speed, "the URDF has no speed"),
        (f"acceleration_{length}_s2", joint.acceleration, "not in a URDF"),
        (f"following_error_{length}", joint.following_error, "not in a URDF"),
    ):
        if isinstance(value, tuple):
            yield f"{key} = [{', '.join(_number(x * scale) for x in value)}]"
        elif value is not None:
            yield f"{key} = {_number(value * scale)}"
        else:
            yield (
                f"# {key} = {'[LOWEST, HIGHEST]' if remark.endswith('range') else '...'} # "
                f"{FILL_IN}{TO_MOVE}: {remark}"
            )
    key = "effort_n" if joint.type == "prismatic" else "effort_nm"
    yield (
        f"# {key} = ... # {FILL_IN}: the URDF has no effort; without it torques are "
        "checked against the drives only"
        if joint.effort is None
        else f"{key} = {_number(joint.effort)} # at the joint"
    )


def _number(x: float) -> str:
    return f"{x:.10g}"


def _motors_and_controller(chain: Chain) -> Iterator[str]:
    yield ""
    if not all(joint.effort_unit for joint in chain.joints):
        yield from (
            f"# {FILL_IN}{TO_FIT_MOTORS}: for each motor",
            "#     ratio = 100               motor rad (or m) per joint rad (or m), sign included",
            "#     drive_gain = 0.12         motor torque per unit of recorded effort, with "
            'drive_gain_unit = "N m/A"',
            "# instead of effort_unit. As written here, the drives record the torque or force "
            "at the joint.",
        )
    for j, joint in enumerate(chain.joints):
        yield from ("[[motor]]", f'name = "motor_{j + 1}"', *_motor(chain, joint))
    yield from (
        "",
        "[controller]",
        f"# bandwidth_hz = ... # {FILL_IN}: of the position loop; sets the filters, excite needs it"
        if chain.bandwidth_hz is None
        else f"bandwidth_hz = {_number(chain.bandwidth_hz)} # of the position loop; sets the "
        "filters",
        f"# {FILL_IN}, for iv fits and realistic simulations: the drives' control law, in "
        "recorded effort per motor rad",
        '# structure = "cascade_p_pi" # or pd, pd_velocity_feedforward, cascade_p_p, pid, '
        "computed_torque",
        "# sample_rate_hz = 1000",
        *(
            f"# {gain} = [{', '.join(['...'] * len(chain.joints))}]"
            for gain in ("position_gain", "velocity_gain", "integral_gain")
        ),
    )


def _motor(chain: Chain, joint: UrdfJoint) -> Iterator[str]:
    """Yield the lines of ratio, drive gain and unit of the effort.

    A gain stays a comment until the ratio is known too, because it would give wrong N m.
    """
    torque = "N" if joint.type == "prismatic" else "N m"
    unit = joint.effort_unit or torque
    known = None not in (joint.ratio, joint.drive_gain) and unit in OF_GAINS
    if joint.ratio is not None:
        yield f"ratio = {_number(joint.ratio)}"
    elif joint.effort_unit and not chain.torque_sensors:
        yield (
            f"# ratio = ... # {FILL_IN}{TO_FIT_MOTORS}: motor rad (or m) per joint rad (or m), "
            "sign included; leave it out for efforts at the joint"
        )
    if unit in OF_GAINS:
        gain = "..." if joint.drive_gain is None else _number(joint.drive_gain)
        mark = f" # {FILL_IN} to fit in {torque}: replaces effort_unit, together with ratio"
        lines = (f"drive_gain = {gain}", f'drive_gain_unit = "{torque}/{unit}"')
        yield from lines if known else (f"# {lines[0]}{mark}", f"# {lines[1]}")
    if not known:
        yield f'effort_unit = "{unit}"'


def _parameters(chain: Chain, robot: Robot) -> Iterator[str]:
    """Yield a priori values: the links' lumped inertials, with Khalil's names."""
    values = InverseModel(robot).link_parameters()
    if not chain.has_inertials:
        return
    rotors = "" if chain.torque_sensors else "rotor inertias, which are not in a URDF, and "
    yield from (
        "",
        "# A priori values: the URDF's inertials about the joints' frames (fixed and locked "
        "links lumped), its damping and",
        "# friction. Simulations use them; a fit does not.",
        f"# {FILL_IN}: {rotors}missing friction; without values they are 0.",
        "[parameters]",
    )
    for j, joint in enumerate(chain.joints):
        known = (*values[j], joint.damping, joint.friction)
        yield f"# {one_line(', '.join(chain.rigid[j][:8]))}{' ...' * (len(chain.rigid[j]) > 8)}"
        yield from (
            f"{name}{j + 1} = {value:.15g}"
            for name, value in zip((*LINK, "Fv", "Fc"), known, strict=True)
            if abs(value) > _MAX_ROUNDING
        )
        # Example values of what the URDF does not have follow from the joint's effort and speed.
        effort, speed = joint.effort or _DEFAULT_EFFORT, joint.speed or _DEFAULT_SPEED
        small = _EFFORT_SHARE * effort
        yield from (
            f"{_EXAMPLE}{name}{j + 1} = {value:.3g}"
            for name, value, known in (
                ("Ia", small / (speed / _RISE_S), chain.torque_sensors),
                ("Fv", small / speed, joint.damping),
                ("Fc", small, joint.friction),
            )
            if not known
        )


def _drives(chain: Chain) -> Iterator[str]:
    """Yield the example drives, without the marks of their lines."""
    period_ms = max(_SHORTEST_SYNC_MS, math.ceil(2 * _SYNC_PER_DRIVE_MS * len(chain.joints)) / 2)
    yield from (
        "[bus]",
        'interface = "virtual" # or "socketcan"',
        'channel = "made_up"',
        f"sync_period_s = {_number(period_ms / 1000)}",
    )
    for j, joint in enumerate(chain.joints):
        slides = joint.type == "prismatic"
        rated, counts = ("force_n", "m") if slides else ("torque_nm", "turn")
        yield from (
            "[[bus.drive]]",
            f"node = {j + 1}",
            'reference = "6074" # target torque or force',
            *(['reference_rule = "per mille of rated force"'] if slides else []),
            f"rated_{rated} = {_number(_RATED_SHARE * (joint.effort or _DEFAULT_EFFORT))}",
            f"counts_per_{counts} = {_COUNTS}",
        )


def correct_description(
    robot: Robot, causes: Sequence[Cause], q: Array, place: str
) -> tuple[Robot, list[str]]:
    """Return the robot without these mistakes, and lines on what has changed in its description.

    Each new value is below a remark, and `unconfirmed` names the joints that have changed.

    Parameters
    ----------
    robot : the robot of the fit.
    causes : the mistakes, in the order in which they are to be undone.
    q : (N, n) recorded positions, rad or m.
    place : name of the corrected description in errors.

    Raises
    ------
    BadInputError : no robot.toml expresses the correction, or it cannot be edited line by line.
    """
    x, text, one = undo(robot, causes), robot.files["robot.toml"].decode(), np.eye(robot.n)
    R, zero, gains = Location(place).given(
        x.keys(robot),
        text=f"{x.text}, which no robot.toml corrects",
        advice=x.advice(robot).removesuffix("."),
    )
    by_ratio = np.count_nonzero(robot.R) == robot.n
    rows: list[tuple[str, str, str, Any, Any]] = [
        *(
            ("motor", motor.name, "ratio", robot.R[k, k], R[k, k])
            for k, motor in enumerate(robot.motors)
            if by_ratio
        ),
        *(
            ("motor", motor.name, "drive_gain", motor.drive_gain, motor.drive_gain * gain)
            for motor, gain in zip(robot.motors, gains, strict=True)
            if motor.drive_gain
        ),
        *(
            ("joint", joint.name, joint.key(key), was * unit, now * unit)
            for k, joint in enumerate(robot.joints)
            for unit in [DEGREES if joint.type == "revolute" else 1.0]
            for key, was, now in (
                ("zero", robot.zero[k], zero[k]),
                ("position", *_limits(robot, k, x, q)),
            )
        ),
        ("", robot.name, "motor_matrix", robot.R, robot.R if by_ratio else R),
        ("", robot.name, "gravity_m_s2", robot.gravity, robot.gravity + x.d),
    ]
    changes = [
        (*of, np.round(was, 9).tolist(), np.round(now, 9).tolist())
        for *of, was, now in rows
        if not np.allclose(was, now)
    ]
    moved = np.c_[x.P - one, x.A - one, x.t].round(9).any(axis=1) | x.d.any()
    names = [
        joint.name
        for joint, it in zip(robot.joints, moved, strict=True)
        if it or joint.name in robot.unconfirmed
    ]
    text = replace_in_tables(
        text,
        "",
        {robot.name: {"unconfirmed": names}},
        place,
        "" if robot.unconfirmed else _UNCONFIRMED,
    )
    for kind, name, key, was, now in changes:
        text = replace_in_tables(
            text, kind, {name: {key: now}}, place, f"corrected from a recording, was {was}"
        )
    # The control law of a dry run belongs to the recording.
    files = {name: x for name, x in robot.files.items() if name != SIMULATED_CONTROLLER}
    return robot_from_files(files | {"robot.toml": text.encode()}, place), [
        f"{name}: {key} = {now} (was {was})" for _, name, key, was, now in changes
    ]


def _limits(robot: Robot, k: int, undone: Undone, q: Array) -> tuple[Array, Array]:
    """Return the limits of position of a joint before and after, (2,) each; empty without limits.

    They follow its sign and zero, unless the URDF has the same, which belong to its frames, or only
    the present ones include the corrected positions of q (N, n).
    """
    joint, urdf = robot.joints[k], ET.fromstring(robot.urdf or "<robot/>")
    now, limit = (
        np.array(joint.si("position") or ()),
        urdf.find(f"joint[@name='{joint.name}']/limit"),
    )
    followed, x = np.sort(undone.P[k, k] * now + undone.t[k]), (q @ undone.P.T + undone.t)[:, k]
    inside = [(of[:1] <= x.min()).all() and (x.max() <= of[1:]).all() for of in (now, followed)]
    kept = inside == [True, False] or (
        limit is not None
        and now.size
        and np.allclose(
            now, [float(limit.get(key, "nan")) for key in ("lower", "upper")], atol=1e-3
        )
    )
    return now, now if kept else followed
