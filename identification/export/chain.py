"""Read the joints of a URDF to identify: the longest serial chain, or the joints named; the
others stay locked at zero.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.errors import listed
from acquisition.files import read_bytes

from ..errors import BadInputError
from .urdf_tree import MOVABLE, UrdfTree, attribute_of, finite_number

INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_JOINT_NAME = re.compile(r"[A-Za-z0-9_.\- ]{1,64}")  # as in robot.toml
_MAX_ROUNDING = 1e-6  # relative to the largest principal moment: CAD programs write few digits
_NUMBERS = {
    "speed": ("limit", "velocity"),
    "effort": ("limit", "effort"),
    "damping": ("dynamics", "damping"),
    "friction": ("dynamics", "friction"),
}
_OPTION_FIELDS = {"--range": "position"} | {
    f"--{name}": name.replace("-", "_")
    for name in ("speed", "acceleration", "following-error", "ratio", "drive-gain")
}
_OF_A_HAND = re.compile("finger|thumb|gripper|knuckle|jaw", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class UrdfJoint:
    """A joint of the chain, SI: rad or m, N m or N. Missing values are None; missing
    damping and friction are 0.

    Acceleration, following error, ratio, drive gain (motor N m or N per unit of effort) and the
    unit of the recorded effort (empty: N m or N at the joint) come from options.
    """

    name: str
    type: str
    position: tuple[float, float] | None = None
    speed: float | None = None
    effort: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    acceleration: float | None = None
    following_error: float | None = None
    ratio: float | None = None
    drive_gain: float | None = None
    effort_unit: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The robot to identify, from the URDF `place` and its options.

    Attributes:
        name: of the robot, valid in robot.toml.
        joints: joints to identify, numbered from the base outwards.
        locked: the other movable joints, fixed at zero, each with its type and the joint it mimics.
        rigid: for each joint of the chain, the links that move with it as one body.
        notes: what is odd in the inertials.
        has_inertials: whether they are a-priori values: masses of all joints, none impossible.
        bandwidth_hz: of the position loops; not part of a URDF.
        torque_sensors: whether these are the source of the recorded efforts.
    """

    place: str
    name: str
    text: bytes
    joints: tuple[UrdfJoint, ...]
    locked: tuple[str, ...] = ()
    rigid: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()
    has_inertials: bool = True
    bandwidth_hz: float | None = None
    torque_sensors: bool = False

    def with_options(self, options: Mapping[str, Sequence[float]]) -> "Chain":
        """Apply options in rad or m (per s, s²) and Hz: one value for all joints, or one for each.

        `--range` is ± about zero. The URDF's range and speed still apply; of several
        `--bandwidth-hz` the lowest is used. Raises `BadInputError`: a wrong number of values, a
        range outside the URDF's.
        """
        joints, n = list(self.joints), len(self.joints)
        for option, values in options.items():
            if len(values) not in (1, n):
                raise BadInputError(
                    place=self.place,
                    key=option,
                    value=values,
                    shown=f"{len(values)} values",
                    expected=f"one, or {n} for {', '.join(joint.name for joint in joints)}",
                )
            if (
                len(values) < n
                and len({joint.type for joint in joints}) > 1
                and option in _OPTION_FIELDS
            ):
                raise BadInputError(
                    place=self.place,
                    key=option,
                    value=values[0],
                    expected=f"{n} values: some joints are in rad, others in m",
                )
            for j, joint in enumerate(joints if option in _OPTION_FIELDS else ()):
                value: Any = values[j % len(values)]
                if option == "--range":
                    value = _intersect_range(joint, value, self.place)
                elif option == "--speed":
                    value = min(joint.speed or value, value)
                joints[j] = replace(joint, **{_OPTION_FIELDS[option]: value})
        return replace(
            self,
            joints=tuple(joints),
            bandwidth_hz=min(options.get("--bandwidth-hz", ()), default=None),
        )


def _intersect_range(joint: UrdfJoint, side: float, place: str) -> tuple[float, float]:
    low, high = joint.position or (-side, side)
    narrowed = max(low, -side), min(high, side)
    if not narrowed[0] < narrowed[1]:
        unit = "m" if joint.type == "prismatic" else "rad"
        raise BadInputError(
            place=f"{place}: joint {joint.name!r}",
            key="--range",
            value=side,
            expected=f"a range that overlaps the URDF's, {low:g} to {high:g} {unit}",
        )
    return narrowed


def read_chain(path: Path, names: Sequence[str] = ()) -> Chain:
    """Read a URDF with its limits, damping and friction.

    `names` are the joints to identify, from the base outwards; by default the longest serial chain
    without fingers. Raises `BadInputError`: not a URDF, not one tree, floating or planar joints,
    two chains of equal length, invalid numbers, reversed limits.
    """
    text = read_bytes(path)
    tree = UrdfTree(text, str(path))
    for i, name in enumerate(names):
        if name not in tree.movable or name in names[:i]:
            raise BadInputError(
                place=tree.place,
                key="--joints",
                value=name,
                expected=f"one of {listed(tree.movable)}, each once",
            )
    chain = list(names) or _find_longest(tree)
    for name in dict.fromkeys(joint for last in chain for joint in tree.path(last)):
        kind = tree.joints[name].get("type")
        if kind in ("floating", "planar"):
            raise BadInputError(
                place=f"{path}: joint {name!r}, between the base and joint {chain[-1]!r}",
                key="type",
                value=kind,
                expected="fixed, revolute, continuous or prismatic joints on a fixed base",
            )
    rigid: dict[str, list[str]] = {name: [] for name in chain}
    for link in tree.links:
        carried = [joint for joint in tree.path(tree.above.get(link)) if joint in rigid]
        if carried:  # a link moves with the last joint of the chain below it
            rigid[carried[-1]].append(link)
    others = [
        name
        for name, joint in tree.joints.items()
        if name not in chain and joint.get("type") != "fixed"
    ]
    lacks, notes = _check_inertials(tree, rigid)
    return Chain(
        place=str(path),
        name="".join(c if c.isascii() and (c.isalnum() or c in "_.- ") else "_" for c in tree.name)[
            :64
        ]
        or "robot",
        text=text,
        joints=tuple(_read_joint(tree, name) for name in chain),
        locked=tuple(_describe_locked(tree, name) for name in others),
        rigid=tuple(tuple(links) for links in rigid.values()),
        notes=(*lacks, *notes),
        has_inertials=not lacks,
    )


def _find_longest(tree: UrdfTree) -> list[str]:
    free = {name for name in tree.movable if not _OF_A_HAND.search(name)} or {*tree.movable}
    if not free:
        raise BadInputError(
            "no joint moves",
            place=tree.place,
            expected=f"joints of the types {', '.join(MOVABLE)}",
        )
    chains = {
        name: [joint for joint in tree.path(name) if joint in free]
        for name in tree.movable
        if name in free
    }
    most = max(map(len, chains.values()))
    last = [name for name, chain in chains.items() if len(chain) == most]
    if len(last) > 1:
        raise BadInputError(
            f"{len(last)} chains of {most} joints each, which end at {listed(last)}",
            place=tree.place,
            expected="--joints with the joints of one chain",
        )
    return chains[last[0]]


def _describe_locked(tree: UrdfTree, name: str) -> str:
    joint = tree.joints[name]
    mimicked = (
        f", mimics {attribute_of(joint, 'mimic', 'joint')}"
        if joint.find("mimic") is not None
        else ""
    )
    return f"{name}: {joint.get('type')}{mimicked}"


def _read_joint(tree: UrdfTree, name: str) -> UrdfJoint:
    if not _JOINT_NAME.fullmatch(name):
        raise BadInputError(
            place=tree.place,
            key="name of a joint",
            value=name,
            expected="1 to 64 letters, digits, spaces, and _ . -, as in robot.toml",
        )
    joint, at = tree.joints[name], f"{tree.place}: joint {name!r}"

    def number(tag: str, attribute: str) -> float:
        text = attribute_of(joint, tag, attribute)
        return 0.0 if text is None else finite_number(text, at, f"{tag} {attribute}")

    kind, low, high = joint.get("type"), number("limit", "lower"), number("limit", "upper")
    if kind != "continuous" and low > high:
        raise BadInputError(
            place=at, key="limit lower", value=low, expected=f"less than upper = {high:g}"
        )
    numbers = {key: number(*where) for key, where in _NUMBERS.items()}
    for key, value in numbers.items():
        if value < 0:
            raise BadInputError(
                place=at, key=" ".join(_NUMBERS[key]), value=value, expected="a number from 0"
            )
    return UrdfJoint(
        name=name,
        type="prismatic" if kind == "prismatic" else "revolute",
        # Equal limits mean no limits: 0 is the default of both.
        position=None if kind == "continuous" or low == high else (low, high),
        speed=numbers["speed"] or None,
        effort=numbers["effort"] or None,
        damping=numbers["damping"],
        friction=numbers["friction"],
    )


def _check_inertials(
    tree: UrdfTree, rigid: Mapping[str, Sequence[str]]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """A note that there are no a-priori values, where joints move no mass or inertials are
    negative; notes on moments that violate the triangle inequality: these can be simulated.
    """
    negative, notes, masses = list[str](), list[str](), dict.fromkeys(rigid, 0.0)
    for joint, link in ((joint, link) for joint, links in rigid.items() for link in links):
        inertial, at = tree.links[link].find("inertial"), f"{tree.place}: link {link!r}"
        if inertial is None:
            continue
        m = finite_number(attribute_of(inertial, "mass", "value"), at, "mass")
        masses[joint] += abs(m)
        matrix = np.zeros((3, 3))
        matrix[np.triu_indices(3)] = [
            finite_number(attribute_of(inertial, "inertia", k), at, f"inertia {k}") for k in INERTIA
        ]
        moments = np.linalg.eigvalsh(matrix, UPLO="U")
        slack, shown = _MAX_ROUNDING * np.abs(moments).max(), ", ".join(f"{x:.4g}" for x in moments)
        if m < 0 or moments[0] < -slack:
            negative.append(f"link {link} has mass {m:g} kg, principal moments {shown} kg m²")
        elif moments[2] > moments[0] + moments[1] + slack:
            notes.append(
                f"link {link}: principal moments {shown} kg m²: impossible, one exceeds the sum of "
                "the others"
            )
    without = [joint for joint, mass in masses.items() if not mass]
    lacks = [*([f"no mass moves with {listed(without)}"] if without else []), *negative]
    text = f"no [parameters], which a simulation needs and a fit does not: {listed(lacks)}"
    return (text,) * bool(lacks), tuple(notes)
