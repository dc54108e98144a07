"""A URDF as one tree of links and joints; what is no such tree is refused."""

import math
import xml.etree.ElementTree as ET

from acquisition.errors import listed

from ..errors import BadInputError

MOVABLE = ("revolute", "continuous", "prismatic")
_TYPES = (*MOVABLE, "fixed", "floating", "planar")


class UrdfTree:
    """A URDF that is one tree: its links and joints by name, and `above`, the joint
    that carries each link.
    """

    def __init__(self, text: bytes, place: str) -> None:
        try:
            robot = ET.fromstring(text)
        except (ET.ParseError, ValueError, LookupError) as error:
            raise BadInputError(f"is not XML: {error}", place=place, expected="a URDF") from error
        if robot.tag != "robot":
            raise BadInputError(
                place=place,
                key="its root",
                value=robot.tag,
                shown=f"<{robot.tag}>",
                expected="<robot>, of a URDF",
            )
        if any("xacro" in str(element.tag) for element in robot.iter()):
            raise BadInputError(
                "has xacro elements",
                place=place,
                expected="a URDF: xacro FILE > robot.urdf makes it",
            )
        self.place, self.name = place, robot.get("name") or ""
        self.links, self.joints = (_by_name(robot, tag, place) for tag in ("link", "joint"))
        self.above: dict[str, str] = {}
        for name, joint in self.joints.items():
            self._check_joint(name, joint)
            self.above[_end(joint, "child")] = name
        roots = [link for link in self.links if link not in self.above]
        if len(roots) != 1:
            raise BadInputError(
                f"{len(roots)} root links: {listed(roots)}"
                if roots
                else "no root link: its joints form a loop",
                place=place,
                expected="one base link, which is no joint's child",
            )
        if loop := [
            link for link in self.links if len(self.path(self.above.get(link))) > len(self.joints)
        ]:
            raise BadInputError(
                f"links {listed(loop)} are in a loop of joints",
                place=place,
                expected="a tree below one base link",
            )

    def _check_joint(self, name: str, joint: ET.Element) -> None:
        at, kind = f"{self.place}: joint {name!r}", joint.get("type")
        if kind not in _TYPES:
            raise BadInputError(
                place=at, key="type", value=kind, expected=f"one of {', '.join(_TYPES)}"
            )
        for tag in ("parent", "child"):
            if _end(joint, tag) not in self.links:
                raise BadInputError(
                    place=at,
                    key=tag,
                    value=_end(joint, tag) or None,
                    expected=f"one of the links {listed([*self.links])}",
                )
        child = _end(joint, "child")
        if child in self.above:
            raise BadInputError(
                place=at,
                key="child",
                value=child,
                expected=f"one parent joint per link; {self.above[child]!r} is another of this one",
            )

    def path(self, joint: str | None) -> list[str]:
        """The joints from the root to `joint`, including it; more than the URDF
        has if they form a loop.
        """
        path: list[str] = []
        while joint is not None and len(path) <= len(self.joints):
            path.append(joint)
            joint = self.above.get(_end(self.joints[joint], "parent"))
        return path[::-1]

    @property
    def movable(self) -> list[str]:
        """Revolute, continuous and prismatic joints that mimic no other joint."""
        return [
            name
            for name, j in self.joints.items()
            if j.get("type") in MOVABLE and j.find("mimic") is None
        ]


def _by_name(robot: ET.Element, tag: str, place: str) -> dict[str, ET.Element]:
    elements: dict[str, ET.Element] = {}
    for i, element in enumerate(robot.findall(tag)):
        name = element.get("name")
        if not name or name in elements:
            raise BadInputError(
                place=f"{place}: {tag} {i + 1}",
                key="name",
                value=name or None,
                expected="a name not used before" if name else "a name",
            )
        elements[name] = element
    if not elements:
        raise BadInputError(f"has no {tag}", place=place, expected="links, and joints between them")
    return elements


def _end(joint: ET.Element, tag: str) -> str:
    """The `parent` or `child` link of a joint; empty if missing."""
    return attribute_of(joint, tag, "link") or ""


def attribute_of(element: ET.Element, tag: str, name: str) -> str | None:
    """Return an attribute of the first child `tag`; None without one."""
    child = element.find(tag)
    return None if child is None else child.get(name)


def finite_number(text: str | None, place: str, key: str) -> float:
    """Read a number of a URDF; what is none or infinite is refused."""
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadInputError(place=place, key=key, value=text, expected="a finite number")
    return value
