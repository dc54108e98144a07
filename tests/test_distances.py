"""Bounds of distances: capsules hold their shapes, and no pair of shapes is nearer than its capsules are."""

import coal
import numpy as np
import pinocchio as pin
import pytest

from identification.model import Obstacles
from identification.model.obstacles import Shape, bounding_capsule, segments_apart


def test_the_distance_of_segments_is_that_of_their_points():
    """Against the least distance of a million pairs of points: random, parallel, crossing segments, and points."""
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 40, 2, 3))
    b[:8, 1] = b[:8, 0] + rng.uniform(-2, 2, (8, 1)) * (a[:8, 1] - a[:8, 0])
    b[8:12] = a[8:12].mean(axis=1, keepdims=True) + np.array([-1, 1])[:, None] * rng.standard_normal((4, 1, 3))
    a[12:16, 1], b[14:20, 1] = a[12:16, 0], b[14:20, 0]
    s = np.linspace(0, 1, 1001)[:, None]
    for found, (p, q) in zip(segments_apart(a, b), zip(a, b, strict=True), strict=True):
        on_a, on_b = ((1 - s) * x[0] + s * x[1] for x in (p, q))
        squares = (on_a**2).sum(axis=1)[:, None] + (on_b**2).sum(axis=1) - 2 * on_a @ on_b.T
        by_points = np.sqrt(max(squares.min(), 0.0))
        assert by_points - 5e-3 <= found <= by_points + 1e-7


def hull(points):
    vertices = coal.StdVec_Vec3s()
    vertices.extend(list(points))
    return coal.ConvexBase.convexHull(vertices, True, "Qt")


def solids():
    rng = np.random.default_rng(1)
    yield from (coal.Box(0.3, 0.2, 0.9), coal.Sphere(0.2), coal.Cylinder(0.1, 0.6), coal.Capsule(0.1, 0.4))
    yield from (coal.Box(0.5, 0.5, 0.01), coal.Cylinder(0.4, 0.1))
    yield from (
        hull(rng.standard_normal((30, 3)) * sides + rng.standard_normal(3)) for sides in rng.uniform(0.05, 1, (6, 3))
    )


def points_of(solid):
    """Points of a shape's surface, or beyond it on a box about it: a capsule that holds them holds the shape."""
    if isinstance(solid, coal.Convex):
        return np.array([solid.point(i) for i in range(solid.num_points)])
    directions = np.random.default_rng(2).standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    if isinstance(solid, coal.Sphere):
        return solid.radius * directions
    if isinstance(solid, coal.Capsule):
        return solid.radius * directions + np.array([0, 0, solid.halfLength]) * np.sign(directions[:, 2:])
    if isinstance(solid, coal.Box):
        return np.sign(directions) * np.asarray(solid.halfSide)
    flat = directions[:, :2] / np.linalg.norm(directions[:, :2], axis=1)[:, None]
    return np.column_stack([solid.radius * flat, solid.halfLength * np.sign(directions[:, 2])])


@pytest.mark.parametrize("solid", list(solids()), ids=lambda solid: type(solid).__name__)
def test_a_capsule_holds_its_shape(solid):
    solid.computeLocalAABB()
    ends, radius = bounding_capsule(solid)
    points = points_of(solid)
    axis = np.broadcast_to(ends, (len(points), 2, 3))
    apart = segments_apart(axis, np.stack([points, points], axis=1))
    assert apart.max() <= radius + 1e-12
    assert radius <= 1.001 * np.ptp(points, axis=0).max()


def test_the_nearest_pair_is_found_though_not_all_are_looked_at():
    """A tree of free bodies in all shapes: distances and pairs as of looking at each pair."""
    model, rng = pin.Model(), np.random.default_rng(3)
    shapes = []
    for i, solid in enumerate(solids()):
        parent = model.addJoint(i, pin.JointModelRX() if i % 2 else pin.JointModelRZ(), pin.SE3.Random(), f"j{i}")
        shapes.append(Shape(link=parent, name=f"s{i}", placement=pin.SE3.Random(), geometry=solid))
    ground = Shape(
        link=0, name="ground", placement=pin.SE3.Identity(), geometry=coal.Halfspace(np.array([0.0, 0.0, 1.0]), -4.0)
    )
    pairs = [(a, b) for i, a in enumerate(shapes) for b in shapes[i + 2 :]] + [(ground, shape) for shape in shapes]
    obstacles = Obstacles(model=model, pairs=tuple(pairs), near=())
    q = rng.uniform(-3, 3, (25, model.nq))
    each = np.empty((len(q), len(pairs)))
    for k, qk in enumerate(q):
        data = model.createData()
        pin.forwardKinematics(model, data, qk)
        for p, (a, b) in enumerate(pairs):
            here = [data.oMi[shape.link] * shape.placement for shape in (a, b)]
            at = [coal.Transform3s(x.rotation, x.translation) for x in here]
            result = coal.DistanceResult()
            coal.distance(a.geometry, at[0], b.geometry, at[1], coal.DistanceRequest(), result)
            each[k, p] = result.min_distance
    bounds = obstacles._lower_bounds(q)
    assert (bounds <= each + 1e-6).all()
    assert np.median((bounds / each)[each > 0]) > 0.6  # near enough to spare most searches
    d, names = obstacles.nearest(q, 9.0)
    assert d == pytest.approx(each.min(axis=1), abs=1e-6)
    clear = np.sort(each, axis=1)[:, :2] @ [-1, 1] > 1e-3
    assert [n for n, ok in zip(names, clear, strict=True) if ok] == [
        obstacles.names[p] for p, ok in zip(each.argmin(axis=1), clear, strict=True) if ok
    ]
    assert np.array_equal(obstacles.nearest(q, -9.0)[0], np.full(len(q), -9.0))
