"""The joints of a URDF that are identified: the longest serial chain, or those named; all others stay locked at zero."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from acquisition.errors import listed

from ..errors import IdentificationError
from .links import check_inertials
from .tree import MOVABLE, Tree, attribute, check_name, end, movable, read_tree

_ENDINGS = (".urdf", ".xacro", ".xml")


@dataclass(frozen=True, kw_only=True)
class UrdfJoint:
    """A joint of the chain, SI: rad or m, N m or N. What is not stated is None; damping and friction are 0 then.

    A URDF states no acceleration and no following error: these come from options.
    """

    name: str
    type: str
    child: str
    position: tuple[float, float] | None
    speed: float | None
    effort: float | None
    damping: float
    friction: float
    acceleration: float | None = None
    following_error: float | None = None

    @property
    def unit(self) -> str:
        """`rad` or `m`."""
        return "m" if self.type == "prismatic" else "rad"


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """What a URDF says of the robot that is identified.

    Attributes:
        place: the file, in errors.
        name: of the robot, as robot.toml takes it.
        text: the URDF.
        joints: those identified, from the base outwards; the number of a joint is its place here.
        locked: the other movable joints, which stay at zero, each with its type and what it mimics.
        rigid: by joint of the chain, the links that move with it as one body.
        notes: links whose inertials no body has, though none of their numbers is negative.
        bandwidth_hz: of the position loops; no URDF states it.
    """

    place: str
    name: str
    text: bytes
    joints: tuple[UrdfJoint, ...]
    locked: tuple[str, ...]
    rigid: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]
    bandwidth_hz: float | None = None


def is_urdf(path: Path) -> bool:
    """Whether a file is taken for a URDF: by its ending, .urdf, .xacro or .xml."""
    return path.suffix.lower() in _ENDINGS


def read_chain(path: Path, names: Sequence[str] = ()) -> Chain:
    """Read a URDF, with the limits, damping and friction that it states.

    `names` are the joints to identify, from the base outwards; by default those of the longest serial chain. The
    `IdentificationError` is one line with file, link or joint, value and what was expected: not a URDF, not one tree, joints
    that no chain can have, two chains of one length, numbers that are none, limits upside down, negative masses or inertias.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise IdentificationError(f"cannot be read: {error.strerror}", place=str(path)) from error
    tree = read_tree(text, str(path))
    chain = _named(tree, names) if names else _longest(tree)
    for name in dict.fromkeys(joint for last in chain for joint in tree.path(last)):
        kind = tree.joints[name].get("type")
        if kind in ("floating", "planar"):
            at = f"{path}: joint {name!r}, between the base and joint {chain[-1]!r}"
            expected = "fixed, revolute, continuous or prismatic joints below a base that stands still"
            raise IdentificationError(place=at, key="type", value=kind, expected=expected)
    rigid = _bodies(tree, chain)
    others = [name for name, joint in tree.joints.items() if name not in chain and joint.get("type") != "fixed"]
    return Chain(
        place=str(path),
        name="".join(c if c.isascii() and (c.isalnum() or c in "_.- ") else "_" for c in tree.name)[:64] or "robot",
        text=text,
        joints=tuple(_joint(tree, name) for name in chain),
        locked=tuple(_locked(tree, name) for name in others),
        rigid=tuple(tuple(rigid[name]) for name in chain),
        notes=check_inertials(tree, [link for links in rigid.values() for link in links]),
    )


def _longest(tree: Tree) -> list[str]:
    free = set(movable(tree))
    if not free:
        expected = f"joints of the types {', '.join(MOVABLE)}"
        raise IdentificationError("no joint moves", place=tree.place, expected=expected)
    chains = {name: [joint for joint in tree.path(name) if joint in free] for name in free}
    most = max(map(len, chains.values()))
    last = [name for name in tree.joints if len(chains.get(name, ())) == most]
    if len(last) > 1:
        problem = f"{len(last)} chains of {most} joints each: they end at {listed(last)}"
        raise IdentificationError(problem, place=tree.place, expected="--joints with the names of those of one")
    return chains[last[0]]


def _named(tree: Tree, names: Sequence[str]) -> list[str]:
    free = list(movable(tree))
    for i, name in enumerate(names):
        if name not in free or name in names[:i]:
            expected = f"each once, of {listed(free)}"
            raise IdentificationError(place=tree.place, key="--joints", value=name, expected=expected)
    return list(names)


def _locked(tree: Tree, name: str) -> str:
    mimic = tree.joints[name].find("mimic")
    what = f"{name}: {tree.joints[name].get('type')}"
    return what if mimic is None else f"{what}, mimics {mimic.get('joint')}"


def _bodies(tree: Tree, chain: Sequence[str]) -> dict[str, list[str]]:
    """By joint of the chain, the links that it carries and no later joint of the chain does."""
    bodies: dict[str, list[str]] = {name: [] for name in chain}
    for link in tree.links:
        carried = [joint for joint in tree.carriers(link) if joint in bodies]
        if carried:
            bodies[carried[-1]].append(link)
    return bodies


def _joint(tree: Tree, name: str) -> UrdfJoint:
    check_name(tree, name)
    kind = str(tree.joints[name].get("type"))
    low, high = (attribute(tree, name, "limit", side) or 0.0 for side in ("lower", "upper"))
    at = f"{tree.place}: joint {name!r}"
    if kind != "continuous" and low > high:
        raise IdentificationError(place=at, key="limit lower", value=low, expected=f"less than upper = {high:g}")
    numbers = {}
    for key, (tag, word) in _NUMBERS.items():
        numbers[key] = attribute(tree, name, tag, word) or 0.0
        if numbers[key] < 0:
            raise IdentificationError(place=at, key=f"{tag} {word}", value=numbers[key], expected="a number from 0")
    return UrdfJoint(
        name=name,
        type="prismatic" if kind == "prismatic" else "revolute",
        child=str(end(tree.joints[name], "child")),
        # Equal limits are those of a URDF that states none: 0 is the default of both.
        position=None if kind == "continuous" or low == high else (low, high),
        speed=numbers["speed"] or None,
        effort=numbers["effort"] or None,
        damping=numbers["damping"],
        friction=numbers["friction"],
    )


_NUMBERS = {
    "speed": ("limit", "velocity"),
    "effort": ("limit", "effort"),
    "damping": ("dynamics", "damping"),
    "friction": ("dynamics", "friction"),
}
