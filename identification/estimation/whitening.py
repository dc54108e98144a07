"""Systems whose residuals are white: each joint's rows filtered by the autoregression of its own residual."""

from dataclasses import replace

import numpy as np

from ..arrays import Array
from .confidence import slices
from .system import System


def whitened(
    system: System, Z: Array, rho: Array, order: int, parts: tuple[int, ...] | None = None
) -> tuple[System, Array]:
    """W, Y and Z (r, b) filtered along time, joint by joint, with rows of like size.

    Joint j's filter is 1 - a_1 B ... - a_p B^p with B the row before, by Yule and Walker from the rows of its residual
    rho (r,) that count. A row counts where it and the `order` rows before it do. `parts` are the numbers of instants of several
    recordings, whose first rows have none before them; None for one.
    """
    n, b = len(system.rows), len(system.names)
    stack = np.c_[system.W, Z, system.Y].reshape(n, -1, b + Z.shape[1] + 1)
    used, residual = system.used.reshape(n, -1), rho.reshape(n, -1) * system.used.reshape(n, -1)
    T = stack.shape[1]
    filtered, counts = stack.copy(), used.copy()
    for part in slices(parts or (T,)):
        counts[:, part.start : part.start + order] = 0.0
    for j in range(n):
        h = np.r_[1.0, -autoregression(residual[j], order)]
        filtered[j] = sum(h[k] * np.roll(stack[j], k, axis=0) for k in range(order + 1))
        for k in range(1, order + 1):
            counts[j, order:] *= used[j, order - k : T - k]
    flat = filtered.reshape(n * T, -1)
    return replace(system, W=flat[:, :b], Y=flat[:, -1]).with_rows(counts.reshape(-1)), flat[:, b:-1]


def autoregression(x: Array, order: int) -> Array:
    """Coefficients (order,) that predict x (T,) from what came before, by Yule and Walker; zeros where x is zero."""
    r = np.array([x[k:] @ x[: len(x) - k] for k in range(order + 1)])
    if not r[0] > 0:
        return np.zeros(order)
    places = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
    return np.asarray(np.linalg.solve(r[places] + 1e-9 * r[0] * np.eye(order), r[1:]))
