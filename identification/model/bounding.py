"""Capsules about shapes: the distance of two capsules is one that the shapes have at least, and takes no search.

The distance of two segments: Ericson, Real-Time Collision Detection, section 5.1.9 (2005).
"""

from dataclasses import dataclass
from typing import Any

import coal
import numpy as np

from ..arrays import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Bounding:
    """A capsule about a shape: the ends (2, 3) of its axis in the shape's frame, in m, and its radius in m."""

    ends: Array
    radius: float


def bounding_capsule(geometry: Any) -> Bounding:
    """A capsule that holds a convex shape of coal, along the longest side of its box."""
    if isinstance(geometry, coal.Capsule):
        half = np.array([0.0, 0.0, geometry.halfLength])
        return Bounding(ends=np.array([-half, half]), radius=float(geometry.radius))
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
    reach = np.sqrt(np.maximum(radius**2 - off**2, 0.0))  # a point is inside with an end of the axis so near along it
    first, last = float((apart[:, along] + reach).min()), float((apart[:, along] - reach).max())
    # Of a compact shape the first may be the last: it is near every point between them.
    ends = np.tile(middle, (2, 1))
    ends[:, along] += first, last
    return Bounding(ends=ends, radius=radius)


def segments_apart(a: Array, b: Array) -> Array:
    """Distances (...) of segments a and b from their ends (..., 2, 3)."""
    d, e, r = a[..., 1, :] - a[..., 0, :], b[..., 1, :] - b[..., 0, :], a[..., 0, :] - b[..., 0, :]
    dd, ee, de = (d * d).sum(axis=-1), (e * e).sum(axis=-1), (d * e).sum(axis=-1)
    dr, er = (d * r).sum(axis=-1), (e * r).sum(axis=-1)

    def share(number: Array, of: Array) -> Array:
        return np.clip(np.divide(number, of, out=np.zeros_like(number), where=of > 0), 0.0, 1.0)

    # The nearest point of a to the line of b; of b to that point; and of a to the point of b, which was clipped.
    s = share(de * er - dr * ee, dd * ee - de * de)
    t = share(de * s + er, ee)
    s = share(de * t - dr, dd)
    return np.asarray(np.linalg.norm(r + s[..., None] * d - t[..., None] * e, axis=-1))
