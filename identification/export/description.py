"""The description that a URDF and its options make: the text of a robot.toml, and the robot that this text means."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace

from acquisition.errors import one_line
from acquisition.robot import Robot, robot_from_files

from ..errors import IdentificationError
from ..model import LINK, InverseModel
from .chain import Chain, UrdfJoint

FILL_IN = "FILL IN"
_EXAMPLE = "#: "  # before each line of an example on simulated drives, with which a dry run moves the robot
_EFFORT, _SPEED = 100.0, 3.0  # of the example where the URDF states none
_SHARE, _RISE_S = 0.02, 0.2  # of the effort: what friction takes, and what brings the rotor to full speed in this time
_COUNTS, _RATED_SHARE = 1_000_000, 0.5  # of the example's drives: per turn or m; rated effort over the largest
_ROUNDING = 1e-14  # kg m² and smaller: what the sums of a lumped link leave of zero
_NEEDED = {
    "position": "--range ({}, to each side of zero)",
    "speed": "--speed ({}/s)",
    "acceleration": "--acceleration ({}/s²)",
}  # by a robot that moves, with units


def robot_of_chain(chain: Chain, *, moves: bool = False) -> Robot:
    """The robot of the description that `init` writes, with its URDF and what options state.

    Where it `moves` and a limit or the bandwidth is not stated, an `IdentificationError` names the joint and the option.
    """
    for key, option in _NEEDED.items() if moves else ():
        for joint in chain.joints:
            if getattr(joint, key) is None:
                place = f"{chain.place}: joint {joint.name!r}"
                expected = f"{option.format(joint.unit)}, one value or one per joint"
                raise IdentificationError(place=place, key=key, value=None, expected=expected)
    if moves and chain.bandwidth_hz is None:
        place = f"{chain.place}: joint {chain.joints[0].name!r} and all others"
        expected = "--bandwidth-hz, of the position loops"
        raise IdentificationError(place=place, key="bandwidth", value=None, expected=expected)
    return _robot(describe(chain, "robot.urdf"), chain)


def describe(chain: Chain, urdf: str) -> str:
    """The text of the robot.toml of a chain: a comment says `FILL IN` wherever the URDF and the options state nothing.

    It loads as it stands. `urdf` is the path from its folder. `[parameters]` has the links' inertials, links that are fixed or
    locked lumped into the link that carries them, in the frames of `InverseModel`; damping as Fv and friction as Fc. An
    `IdentificationError` for a URDF that does not load, and for joints that move no mass.
    """
    head = "\n".join([*_head(chain, urdf), *(line for j in range(len(chain.joints)) for line in _joint(chain, j))])
    head += "\n".join(_motors_and_controller(chain))
    drives = [f"# {FILL_IN}: the drives. For the real ones every number here is another one."]
    drives += [_EXAMPLE + line for line in _drives(chain)]
    return "\n".join([head, *_parameters(chain, _robot(head, chain)), "", *drives, ""])


def _robot(text: str, chain: Chain) -> Robot:
    robot = robot_from_files({"robot.toml": text.encode(), "robot.urdf": chain.text}, chain.place)
    return replace(robot, name=chain.name)


def _head(chain: Chain, urdf: str) -> Iterator[str]:
    yield f"# Made by robot-identify init from {one_line(urdf)}. {FILL_IN} marks what a URDF does not say."
    yield "# Angles are in degrees, all else is in SI."
    yield f"# Lines that begin with {_EXAMPLE.strip()} are an example for dry runs; sed -i 's/^{_EXAMPLE}//' takes it."
    yield f"name = {json.dumps(chain.name)}"
    yield f"urdf = {json.dumps(urdf, ensure_ascii=False)} # from the folder of this file"
    yield "# urdf_meshes = true # recordings then carry the meshes, and the robot is drawn by them on any machine"
    yield "gravity_m_s2 = [0, 0, -9.81] # in the frame of the URDF's base; another one for a robot that hangs or is tilted"
    if chain.locked:
        yield ""
        yield "# Locked at zero, each part of the link that carries it:"
        yield from (f"#     {one_line(text)}" for text in chain.locked)
    yield from (f"# note: {one_line(note)}" for note in chain.notes)


def _joint(chain: Chain, j: int) -> Iterator[str]:
    joint = chain.joints[j]
    yield ""
    yield f"[[joint]] # joint {j + 1}: the names of its parameters end in {j + 1}"
    yield f"name = {json.dumps(joint.name)}"
    yield f'type = "{joint.type}"'
    length, scale = ("m", 1.0) if joint.type == "prismatic" else ("deg", math.degrees(1.0))
    moves = "no URDF states it; needed to move"
    for key, value, remark in (
        (f"position_{length}", joint.position, "the URDF states no range"),
        (f"speed_{length}_s", joint.speed, "the URDF states no speed"),
        (f"acceleration_{length}_s2", joint.acceleration, moves),
        (f"following_error_{length}", joint.following_error, moves),
    ):
        if isinstance(value, tuple):
            yield f"{key} = [{', '.join(_number(x * scale) for x in value)}]"
        elif value is not None:
            yield f"{key} = {_number(value * scale)}"
        else:
            yield f"# {key} = {'[LOWEST, HIGHEST]' if remark.endswith('range') else '...'} # {FILL_IN}: {remark}"
    key = "effort_n" if joint.type == "prismatic" else "effort_nm"
    if joint.effort is None:
        yield f"# {key} = ... # {FILL_IN}: the URDF states no effort; without it torques are checked against the drives alone"
    else:
        yield f"{key} = {_number(joint.effort)} # at the joint"


def _number(x: float) -> str:
    return f"{x:.10g}"


def _motors_and_controller(chain: Chain) -> Iterator[str]:
    yield ""
    yield ""
    yield f"# {FILL_IN}: for each motor"
    yield "#     ratio = 100               motor rad (or m) per joint rad (or m), sign included"
    yield '#     drive_gain = 0.12         motor torque per unit of recorded effort, with drive_gain_unit = "N m/A"'
    yield "# in place of effort_unit. As they stand here, the drives record the torque or force of the joint itself."
    for j, joint in enumerate(chain.joints):
        yield "[[motor]]"
        yield f'name = "motor_{j + 1}"'
        yield f"effort_unit = {json.dumps('N' if joint.type == 'prismatic' else 'N m')}"
    yield ""
    yield "[controller]"
    if chain.bandwidth_hz is None:
        yield f"# bandwidth_hz = ... # {FILL_IN}: of the position loop; filters follow from it, and fits need it"
    else:
        yield f"bandwidth_hz = {_number(chain.bandwidth_hz)} # of the position loop; filters follow from it"
    yield f"# {FILL_IN}, for fits by iv and honest simulations: the control law of the drives, in recorded effort per motor rad"
    yield '# structure = "cascade_p_pi" # or pd, pd_velocity_feedforward, cascade_p_p, pid, computed_torque'
    yield "# sample_rate_hz = 1000"
    for gain in ("position_gain", "velocity_gain", "integral_gain"):
        yield f"# {gain} = [{', '.join(['...'] * len(chain.joints))}]"


def _parameters(chain: Chain, robot: Robot) -> Iterator[str]:
    """A-priori values: the links' inertials as pinocchio lumps them, in Khalil's names."""
    model = InverseModel(robot)
    values = model.link_parameters()
    yield ""
    yield "# A-priori values: the URDF's inertials about the joints' frames (fixed and locked links lumped), its damping and"
    yield "# friction. Simulations move the robot by them; a fit does not use them."
    yield f"# {FILL_IN}: rotor inertias, which no URDF states, and frictions that this one does not; they are 0 without."
    yield "[parameters]"
    for j, joint in enumerate(chain.joints):
        mass = values[j, LINK.index("M")]
        if not mass > 0:
            raise IdentificationError(
                place=f"{chain.place}: joint {joint.name!r}",
                key=f"mass of link {joint.child!r} and those fixed to it",
                value=float(mass),
                expected="more than 0: an <inertial> in one of them",
            )
        yield f"# {one_line(', '.join(chain.rigid[j][:8]))}{' ...' if len(chain.rigid[j]) > 8 else ''}"
        for name, value in (*zip(LINK, values[j], strict=True), ("Fv", joint.damping), ("Fc", joint.friction)):
            if abs(value) > _ROUNDING:
                yield f"{name}{j + 1} = {value:.15g}"
        yield from _example_terms(joint, j + 1)


def _example_terms(joint: UrdfJoint, number: int) -> Iterator[str]:
    """What a URDF does not state of a joint, of the size that its effort and speed let expect."""
    effort, speed = joint.effort or _EFFORT, joint.speed or _SPEED
    yield f"{_EXAMPLE}Ia{number} = {_SHARE * effort / (speed / _RISE_S):.3g}"
    if not joint.damping:
        yield f"{_EXAMPLE}Fv{number} = {_SHARE * effort / speed:.3g}"
    if not joint.friction:
        yield f"{_EXAMPLE}Fc{number} = {_SHARE * effort:.3g}"


def _drives(chain: Chain) -> Iterator[str]:
    """The example of drives, without the marks of its lines."""
    yield "[bus]"
    yield 'interface = "virtual" # or "socketcan"'
    yield 'channel = "made_up"'
    yield "sync_period_s = 0.002"
    for j, joint in enumerate(chain.joints):
        yield "[[bus.drive]]"
        yield f"node = {j + 1}"
        yield 'reference = "6074" # its target torque or force'
        if joint.type == "prismatic":
            yield 'reference_rule = "per mille of rated force"'
        rated, counts = ("force_n", "m") if joint.type == "prismatic" else ("torque_nm", "turn")
        yield f"rated_{rated} = {_number(_RATED_SHARE * (joint.effort or _EFFORT))}"
        yield f"counts_per_{counts} = {_COUNTS}"
