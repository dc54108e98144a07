"""Links and joints of a URDF as a tree, checked: an error is one line with file, element, value, and what was expected."""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass

from acquisition.errors import listed

from ..errors import IdentificationError

MOVABLE = ("revolute", "continuous", "prismatic")
_TYPES = (*MOVABLE, "fixed", "floating", "planar")
_NAME = re.compile(r"[A-Za-z0-9_.\- ]{1,64}")  # of a joint in robot.toml


@dataclass(frozen=True, kw_only=True, eq=False)
class Tree:
    """A URDF whose joints make one tree of its links.

    Attributes:
        place: the file, in errors.
        root: the link that stands still.
        links: by name, their elements.
        joints: by name, their elements, in the order of the file.
        above: by link, the joint that carries it; the root has none.
    """

    place: str
    name: str
    root: str
    links: dict[str, ET.Element]
    joints: dict[str, ET.Element]
    above: dict[str, str]

    def path(self, joint: str) -> list[str]:
        """The joints from the root to `joint`, in this order, itself included."""
        found = [joint]
        while (parent := end(self.joints[found[-1]], "parent")) in self.above:
            found.append(self.above[parent])
        return found[::-1]

    def carriers(self, link: str) -> list[str]:
        """The joints that carry `link`, from the root on."""
        return self.path(self.above[link]) if link in self.above else []


def read_tree(text: bytes, place: str) -> Tree:
    """Parse a URDF; raises `IdentificationError`, in one line, for anything that is no tree of links and joints."""
    try:
        robot = ET.fromstring(text)
    except (ET.ParseError, ValueError, LookupError) as error:
        raise IdentificationError(f"is not XML: {error}", place=place, expected="a URDF") from error
    if robot.tag != "robot":
        shown = f"<{robot.tag}>"
        expected = "<robot>, of a URDF"
        raise IdentificationError(place=place, key="its root", value=robot.tag, shown=shown, expected=expected)
    if any("xacro" in str(element.tag) for element in robot.iter()):
        expected = "a URDF: xacro FILE > robot.urdf makes it"
        raise IdentificationError("has xacro elements", place=place, expected=expected)
    links = _by_name(robot, "link", place)
    joints = _by_name(robot, "joint", place)
    above: dict[str, str] = {}
    for name, joint in joints.items():
        at = f"{place}: joint {name!r}"
        kind = joint.get("type")
        if kind not in _TYPES:
            raise IdentificationError(place=at, key="type", value=kind, expected=f"one of {', '.join(_TYPES)}")
        for tag in ("parent", "child"):
            link = end(joint, tag)
            if link not in links:
                expected = f"one of the links {listed([*links])}"
                raise IdentificationError(place=at, key=tag, value=link, expected=expected)
        child = str(end(joint, "child"))
        if child in above:
            expected = f"one joint above each link; {above[child]!r} is above this one too"
            raise IdentificationError(place=at, key="child", value=child, expected=expected)
        above[child] = name
    roots = [link for link in links if link not in above]
    if len(roots) != 1:
        problem = f"{len(roots)} root links: {listed(roots)}" if roots else "no root link: its joints make a ring"
        raise IdentificationError(problem, place=place, expected="one link that no joint carries, the base")
    tree = Tree(place=place, name=robot.get("name") or "", root=roots[0], links=links, joints=joints, above=above)
    _refuse_rings(tree)
    return tree


def _by_name(robot: ET.Element, tag: str, place: str) -> dict[str, ET.Element]:
    found: dict[str, ET.Element] = {}
    for i, element in enumerate(robot.findall(tag)):
        name = element.get("name")
        if not name or name in found:
            expected = "a name" if not name else "a name not used before"
            where = f"{place}: {tag} {i + 1}"
            raise IdentificationError(place=where, key="name", value=name or None, expected=expected)
        found[name] = element
    if not found:
        raise IdentificationError(f"has no {tag}", place=place, expected="links, and joints between them")
    return found


def _refuse_rings(tree: Tree) -> None:
    reached, below = {tree.root}, dict[str, list[str]]()
    for joint in tree.joints.values():
        below.setdefault(str(end(joint, "parent")), []).append(str(end(joint, "child")))
    ends = [tree.root]
    while ends:
        ends = [child for link in ends for child in below.get(link, [])]
        reached |= set(ends)
    if apart := [link for link in tree.links if link not in reached]:
        problem = f"links {listed(apart)} are in a ring of joints"
        raise IdentificationError(problem, place=tree.place, expected="a tree below one base link")


def end(joint: ET.Element, tag: str) -> str | None:
    """The link at one end of a joint: `parent` or `child`."""
    found = joint.find(tag)
    return None if found is None else found.get("link")


def attribute(tree: Tree, joint: str, tag: str, name: str) -> float | None:
    """A number of an element of a joint, such as `upper` of `limit`; None where it is not there."""
    element = tree.joints[joint].find(tag)
    text = None if element is None else element.get(name)
    return None if text is None else number(text, f"{tree.place}: joint {joint!r}", f"{tag} {name}")


def number(text: str | None, place: str, key: str) -> float:
    """A finite number from a file; raises `IdentificationError`."""
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise IdentificationError(place=place, key=key, value=text, expected="a finite number")
    return value


def movable(tree: Tree) -> Iterator[str]:
    """The joints that can move on their own: revolute, continuous, prismatic, not mimicking another."""
    return (name for name, joint in tree.joints.items() if joint.get("type") in MOVABLE and joint.find("mimic") is None)


def check_name(tree: Tree, joint: str) -> None:
    """Refuse a name that robot.toml does not take."""
    if not _NAME.fullmatch(joint):
        expected = "1 to 64 letters, digits, spaces, and _ . -, as in robot.toml"
        raise IdentificationError(place=tree.place, key="name of a joint", value=joint, expected=expected)
