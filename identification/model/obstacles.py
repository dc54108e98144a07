"""Distances between the links of a robot, and to the ground: capsules of the description, or the URDF's collision shapes.

Meshes are replaced by their convex hulls; adjacent links are not checked. The distance of the capsules around two shapes is a
closed-form lower bound of the shapes' distance. Distance of two segments: Ericson, Real-Time Collision Detection, section
5.1.9 (2005).
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from acquisition.robot import Capsule

from ..arrays import Array
from ..errors import IdentificationError
from .inverse import InverseModel

_REQUEST = coal.DistanceRequest()

Find = Callable[[str], Path | None]
"""From the name of a mesh in the URDF to its file, or None."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A convex shape fixed to a link (0: the base), at a placement in the link's frame."""

    link: int
    name: str
    placement: Any
    geometry: Any

    def __post_init__(self) -> None:
        self.geometry.computeLocalAABB()

    @cached_property
    def capsule(self) -> tuple[Array, float]:
        """Bounding capsule: ends (2, 3) of its axis in the link's frame, and radius."""
        ends, radius = bounding_capsule(self.geometry)
        return ends @ self.placement.rotation.T + self.placement.translation, radius


@dataclass(frozen=True, kw_only=True, eq=False)
class Obstacles:
    """Pairs of shapes that must not touch.

    Attributes:
        model: pinocchio's model.
        pairs: of shapes; fixed ones belong to link 0.
        near: names of pairs that are too near at all poses and are not checked.
        missing: meshes of the URDF that are not found; their links are checked partly or not at all.
    """

    model: Any
    pairs: tuple[tuple[Shape, Shape], ...]
    near: tuple[str, ...]
    missing: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """(P,) names of the pairs."""
        return tuple(f"{a.name} and {b.name}" for a, b in self.pairs)

    def nearest(self, q: Array, far: float) -> tuple[Array, tuple[str, ...]]:
        """The nearest pair at each of the positions q (N, n): distance (N,) in m, and name.

        Distances are negative if shapes overlap, and at most `far`.
        """
        model, data, q = self.model, self.model.createData(), np.ascontiguousarray(q)
        d, every = np.full(len(q), far), self.names
        least = self._lower_bounds(q)
        nearest_first = np.argsort(least, axis=1)
        names = []
        for k, qk in enumerate(q):
            best, found = int(nearest_first[k, 0]), None
            for p in nearest_first[k]:
                if least[k, p] >= (far if found is None else found.min_distance):
                    break
                if found is None:
                    pin.forwardKinematics(model, data, qk)
                here = _distance(data, *self.pairs[p])
                if found is None or here.min_distance < found.min_distance:
                    best, found = int(p), here
            names.append(every[best])
            if found is not None:
                d[k] = min(found.min_distance, far)
        return d, tuple(names)

    def _lower_bounds(self, q: Array) -> Array:
        """Lower bounds (N, P) of the pairs' distances at the positions q (N, n), from the bounding capsules."""
        model, data = self.model, self.model.createData()
        origins, turns = np.empty((len(q), model.njoints, 3)), np.empty((len(q), model.njoints, 3, 3))
        for k, qk in enumerate(q):
            pin.forwardKinematics(model, data, qk)
            for i, placement in enumerate(data.oMi):
                origins[k, i], turns[k, i] = placement.translation, placement.rotation

        def ends(shape: Shape) -> Array:
            return origins[:, None, shape.link] + shape.capsule[0] @ turns[:, shape.link].swapaxes(1, 2)

        least = np.empty((len(q), len(self.pairs)))
        for p, (a, b) in enumerate(self.pairs):
            if isinstance(a.geometry, coal.Halfspace):
                least[:, p] = (ends(b) @ a.geometry.n).min(axis=1) - a.geometry.d - b.capsule[1]
            else:
                least[:, p] = segments_apart(ends(a), ends(b)) - a.capsule[1] - b.capsule[1]
        return least


def obstacles_of(dynamics: InverseModel, find: Find, poses: Array, margin_m: float) -> Obstacles | None:
    """The pairs of a robot's shapes; None without described capsules, URDF shapes or ground.

    Parameters
    ----------
    dynamics : the model of the robot.
    find : the file of a mesh by its name in the URDF.
    poses : (N, n) positions within the ranges.
    margin_m : pairs that are nearer at all poses are left out: their distance depends on the shapes, not on the motion.

    Raises
    ------
    IdentificationError : if a mesh cannot be read, or a shape is unknown.
    """
    robot, model = dynamics.robot, dynamics.model
    capsules = [(0, "base", robot.base_capsule)]
    capsules += [(j + 1, f"link of {joint.name}", joint.capsule) for j, joint in enumerate(robot.joints)]
    shapes = [_capsule(link, name, capsule) for link, name, capsule in capsules if capsule is not None]
    missing: list[str] = []
    if not shapes and robot.urdf is not None:
        shapes = list(_urdf_shapes(dynamics, find, missing))
    parents = (0, *dynamics.parents)
    pairs = [
        (a, b)
        for i, a in enumerate(shapes)
        for b in shapes[i + 1 :]
        if a.link != b.link and a.link != parents[b.link] and b.link != parents[a.link]
    ]
    if robot.ground_m is not None:
        g = robot.gravity
        up = -g / np.linalg.norm(g) if g.any() else np.array([0.0, 0.0, 1.0])
        half = coal.Halfspace(up, float(robot.ground_m))
        ground = Shape(link=0, name="ground", placement=pin.SE3.Identity(), geometry=half)
        pairs += [(ground, shape) for shape in shapes if shape.link > 0]
    if not pairs and not missing:
        return None
    single = [Obstacles(model=model, pairs=(pair,), near=()) for pair in pairs]
    apart = [one.nearest(poses, np.inf)[0].max() > margin_m for one in single]
    checked = tuple(pair for pair, free in zip(pairs, apart, strict=True) if free)
    near = tuple(one.names[0] for one, free in zip(single, apart, strict=True) if not free)
    return Obstacles(model=model, pairs=checked, near=near, missing=tuple(missing))


def _distance(data: Any, a: Shape, b: Shape) -> Any:
    at_a, at_b = (data.oMi[shape.link] * shape.placement for shape in (a, b))
    found = coal.DistanceResult()
    coal.distance(
        a.geometry,
        coal.Transform3s(at_a.rotation, at_a.translation),
        b.geometry,
        coal.Transform3s(at_b.rotation, at_b.translation),
        _REQUEST,
        found,
    )
    return found


def bounding_capsule(geometry: Any) -> tuple[Array, float]:
    """A capsule around a convex coal shape, along the longest side of its box: ends (2, 3) of its axis, and radius."""
    if isinstance(geometry, coal.Capsule):
        half = np.array([0.0, 0.0, geometry.halfLength])
        return np.array([-half, half]), float(geometry.radius)
    if hasattr(geometry, "points"):
        points = np.array([geometry.point(i) for i in range(geometry.num_points)])
    else:
        box = geometry.aabb_local
        sides = np.array([box.min_, box.max_])
        points = np.array([[sides[i, 0], sides[j, 1], sides[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    low, high = points.min(axis=0), points.max(axis=0)
    along = int(np.argmax(high - low))
    middle = (low + high) / 2
    apart = points - middle
    off = np.linalg.norm(np.delete(apart, along, axis=1), axis=1)
    radius = float(off.max())
    reach = np.sqrt(np.maximum(radius**2 - off**2, 0.0))  # a point is inside if an axis end is this near along it
    first, last = float((apart[:, along] + reach).min()), float((apart[:, along] - reach).max())
    # For a compact shape first may exceed last; every point between them is near enough.
    ends = np.tile(middle, (2, 1))
    ends[:, along] += first, last
    return ends, radius


def segments_apart(a: Array, b: Array) -> Array:
    """Distances (...) of segments a and b from their ends (..., 2, 3)."""
    d, e, r = a[..., 1, :] - a[..., 0, :], b[..., 1, :] - b[..., 0, :], a[..., 0, :] - b[..., 0, :]
    dd, ee, de = (d * d).sum(axis=-1), (e * e).sum(axis=-1), (d * e).sum(axis=-1)
    dr, er = (d * r).sum(axis=-1), (e * r).sum(axis=-1)

    def clipped_ratio(a: Array, b: Array) -> Array:
        return np.clip(np.divide(a, b, out=np.zeros_like(a), where=b > 0), 0.0, 1.0)

    # The point of a nearest to the line of b; of b nearest to that point; of a nearest to that clipped point.
    s = clipped_ratio(de * er - dr * ee, dd * ee - de * de)
    t = clipped_ratio(de * s + er, ee)
    s = clipped_ratio(de * t - dr, dd)
    return np.asarray(np.linalg.norm(r + s[..., None] * d - t[..., None] * e, axis=-1))


def _capsule(link: int, name: str, capsule: Capsule) -> Shape:
    start, end = np.array(capsule.from_m), np.array(capsule.to_m)
    along = end - start
    length = float(np.linalg.norm(along))
    placement = pin.SE3(np.eye(3), (start + end) / 2)
    if length:
        placement.rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along / length).toRotationMatrix()
    return Shape(link=link, name=name, placement=placement, geometry=coal.Capsule(capsule.radius_m, length))


def _urdf_shapes(dynamics: InverseModel, find: Find, missing: list[str]) -> Iterator[Shape]:
    """Collision shapes of the URDF's links, each at the joint that moves it; meshes not found are added to `missing`."""
    for link in ET.fromstring(dynamics.robot.urdf or "").findall("link"):
        name = link.get("name", "")
        for collision in link.findall("collision"):
            frame = dynamics.model.frames[dynamics.model.getFrameId(name)]
            origin, geometry = collision.find("origin"), collision.find("geometry")
            shape = None if geometry is None else next(iter(geometry), None)
            if shape is None:
                continue
            put = pin.SE3.Identity() if origin is None else _placement(origin)
            mesh = shape.get("filename", "") if shape.tag == "mesh" else ""
            file = find(mesh) if mesh else None
            if mesh and file is None:
                missing.append(mesh)
                continue
            solid = _solid(shape, file, f"robot {dynamics.robot.name}: URDF: link {name!r}")
            yield Shape(link=int(frame.parentJoint), name=name, placement=frame.placement * put, geometry=solid)


def _placement(origin: ET.Element) -> Any:
    rpy, xyz = ([float(x) for x in origin.get(key, "0 0 0").split()] for key in ("rpy", "xyz"))
    return pin.SE3(pin.rpy.rpyToMatrix(np.array(rpy)), np.array(xyz))


def _solid(shape: ET.Element, file: Path | None, place: str) -> Any:
    def number(key: str) -> float:
        return float(shape.get(key, "0"))

    if shape.tag == "box":
        return coal.Box(*(float(x) for x in shape.get("size", "0 0 0").split()))
    if shape.tag == "sphere":
        return coal.Sphere(number("radius"))
    if shape.tag == "cylinder":
        return coal.Cylinder(number("radius"), number("length"))
    name = shape.get("filename", "")
    if file is None:
        expected = "box, sphere, cylinder or a mesh with a file"
        raise IdentificationError(place=place, key=f"collision {shape.tag}", value=name or None, expected=expected)
    scale = np.array([float(x) for x in shape.get("scale", "1 1 1").split()])
    try:
        mesh = coal.MeshLoader().load(str(file), scale)
        mesh.buildConvexHull(True, "Qt")
    except (RuntimeError, ValueError) as error:
        expected = "a mesh that coal reads, or capsules in robot.toml"
        raise IdentificationError(place=place, key="collision mesh", value=name, expected=expected) from error
    return mesh.convex
