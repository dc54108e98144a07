"""Distances between the links of a robot, and to the ground.

Links have the capsules of the description, else the collision shapes of the URDF, with meshes
replaced by their convex hulls. Adjacent links are not checked. Pinocchio computes the distances
with coal.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from acquisition.robot import Capsule

from ..arrays import Array
from ..errors import BadInputError
from .inverse import InverseModel

Find = Callable[[str], Path | None]
"""Function that finds the file of a mesh by its name in the URDF; None if it is missing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Obstacles:
    """Pairs of shapes that must not touch.

    Attributes:
        model: pinocchio's model of the joints.
        geometry: pinocchio's model of the shapes and their pairs.
        near: names of pairs that are too near at all poses, and are not checked.
        missing: meshes of the URDF that were not found; their links are checked partly or not at
            all.
    """

    model: Any
    geometry: Any
    near: tuple[str, ...]
    missing: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pairs, (P,)."""
        shapes = [shape.name.rpartition("_")[0] for shape in self.geometry.geometryObjects]
        return tuple(
            f"{shapes[pair.first]} and {shapes[pair.second]}"
            for pair in self.geometry.collisionPairs
        )

    def distances(self, q: Array) -> Array:
        """Return distances (N, P) of the pairs at the positions q (N, n), m.

        They are negative if shapes overlap.
        """
        found = [[one.min_distance for one in found] for _, found in self._along(q)]
        return np.array(found).reshape(len(q), -1)

    def nearest(self, q: Array) -> tuple[float, str]:
        """Return the smallest distance at the positions q (N, n), m, and the name of its pair."""
        apart, pair = min((found[k].min_distance, k) for k, found in self._along(q))
        return float(apart), self.names[pair]

    def _along(self, q: Array) -> Iterator[tuple[int, Any]]:
        """Yield the nearest pair and coal's results of all pairs, at each position of q (N, n)."""
        data, shapes = self.model.createData(), pin.GeometryData(self.geometry)
        for qk in np.ascontiguousarray(q):
            nearest = pin.computeDistances(self.model, data, self.geometry, shapes, qk)
            yield nearest, shapes.distanceResults


def obstacles_of(dynamics: InverseModel, find: Find, poses: Array, margin_m: float) -> Obstacles:
    """Find the pairs of a robot's shapes that must not touch; the ground is a shape too.

    Parameters
    ----------
    dynamics : the robot, whose shapes are its capsules, else those of its URDF.
    find : function that finds the file of a mesh of the URDF.
    poses : (N, n) positions within the limits.
    margin_m : pairs that are nearer at all poses are left out, as their distance depends on the
        shapes, not on the motion.

    Raises
    ------
    BadInputError : a mesh cannot be read.
    """
    robot, geometry, missing = dynamics.robot, pin.GeometryModel(), list[str]()
    if robot.base.ground_m is not None:
        g = robot.gravity
        up = -g / np.linalg.norm(g) if g.any() else np.array([0.0, 0.0, 1.0])
        geometry.addGeometryObject(
            pin.GeometryObject(
                "ground_0", 0, pin.SE3.Identity(), coal.Halfspace(up, float(robot.base.ground_m))
            )
        )
    links = ["base", *(f"link of {joint.name}" for joint in robot.joints)]
    capsules = [robot.base.capsule, *(joint.capsule for joint in robot.joints)]
    for link, (name, capsule) in enumerate(zip(links, capsules, strict=True)):
        if capsule is not None:
            _add_capsule(geometry, link, name, capsule)
    if robot.urdf is not None and not any(capsules):
        _add_urdf_shapes(dynamics, geometry, find, missing)
    geometry.addAllCollisionPairs()
    every = Obstacles(model=dynamics.model, geometry=geometry, near=(), missing=tuple(missing))
    is_near = every.distances(poses).max(axis=0) <= margin_m
    names, pairs = every.names, [(pair.first, pair.second) for pair in geometry.collisionPairs]
    adjacent = np.array([_are_adjacent(dynamics, geometry, *pair) for pair in pairs], dtype=bool)
    for k in np.flatnonzero(adjacent | is_near):
        geometry.removeCollisionPair(pin.CollisionPair(*pairs[k]))
    return replace(
        every, near=tuple(dict.fromkeys(names[k] for k in np.flatnonzero(is_near & ~adjacent)))
    )


def _add_capsule(geometry: Any, link: int, name: str, capsule: Capsule) -> None:
    start, along = np.array(capsule.from_m), np.array(capsule.to_m) - capsule.from_m
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).toRotationMatrix()
    geometry.addGeometryObject(
        pin.GeometryObject(
            f"{name}_0",
            link,
            pin.SE3(turn, start + along / 2),
            coal.Capsule(capsule.radius_m, float(np.linalg.norm(along))),
        )
    )


def _are_adjacent(dynamics: InverseModel, geometry: Any, i: int, k: int) -> bool:
    """Test whether a joint connects the links of two shapes; the first may be the ground."""
    shapes, parents = geometry.geometryObjects, dynamics.model.parents
    a, b = shapes[i].parentJoint, shapes[k].parentJoint
    return shapes[i].name != "ground_0" and bool(parents[a] == b or parents[b] == a)


def _add_urdf_shapes(dynamics: InverseModel, geometry: Any, find: Find, missing: list[str]) -> None:
    """Add the collision shapes of the URDF's links; meshes become convex hulls.

    The names of meshes that are not found are added to `missing`.
    """
    root = ET.fromstring(dynamics.robot.urdf or "")
    for link in root.iter("link"):
        for collision in link.findall("collision"):
            for mesh in collision.iter("mesh"):
                name = mesh.get("filename", "")
                if (file := find(name)) is None:
                    missing.append(name)
                    link.remove(collision)
                else:
                    mesh.set("filename", f"file://{file}")
    try:
        pin.buildGeomFromUrdfString(
            dynamics.model,
            ET.tostring(root, encoding="unicode"),
            pin.GeometryType.COLLISION,
            geometry,
        )
        for shape in geometry.geometryObjects:
            if hasattr(shape.geometry, "buildConvexHull"):
                shape.geometry.buildConvexHull(True, "Qt")
                shape.geometry = shape.geometry.convex
    except (RuntimeError, ValueError) as error:
        raise BadInputError(
            f"a collision shape cannot be read: {error}",
            place=f"robot {dynamics.robot.name}: URDF",
            advice="Use meshes that coal can read, or give capsules in robot.toml",
        ) from error
