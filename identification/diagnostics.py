"""How far a fit can be trusted: torque errors by joint and by state of motion, residual correlation, robust deviations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from .plan import MOVING

Vector = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class TorqueError:
    """Relative torque error 100 |Y - W beta| / |Y| in percent, of all rows and of those that move and stand.

    A row moves where its joint is faster than 2 % of that joint's peak speed. None where there are no such rows or no
    torque. `autocorrelation` is that of the residual at a lag of one decimated sample.
    """

    name: str
    relative_error_percent: float | None
    moving_relative_error_percent: float | None
    standing_relative_error_percent: float | None
    moving_rows: int
    standing_rows: int
    autocorrelation: float | None


def torque_errors(tau: Vector, predicted: Vector, speed: Vector, names: tuple[str, ...]) -> tuple[TorqueError, ...]:
    """Torque errors of each joint and, last and under the name `all`, of all joints; all arrays (rows, n)."""
    moving = np.abs(speed) > MOVING * np.abs(speed).max(axis=0)
    rho = tau - predicted
    each = [_torque_error(name, tau[:, j], rho[:, j], moving[:, j]) for j, name in enumerate(names)]
    return (*each, _torque_error("all", tau, rho, moving))


def lag_one(rho: Vector) -> float | None:
    """Autocorrelation of residuals (rows,) or (rows, n) at a lag of one row; None where they are zero."""
    r, following = rho[:-1].ravel(), rho[1:].ravel()
    size = np.linalg.norm(r) * np.linalg.norm(following)
    return float(r @ following / size) if size > 0 else None


def _torque_error(name: str, tau: Vector, rho: Vector, moving: NDArray[np.bool_]) -> TorqueError:
    return TorqueError(
        name=name,
        relative_error_percent=relative_error_percent(tau, rho),
        moving_relative_error_percent=relative_error_percent(tau[moving], rho[moving]),
        standing_relative_error_percent=relative_error_percent(tau[~moving], rho[~moving]),
        moving_rows=int(moving.sum()),
        standing_rows=int((~moving).sum()),
        autocorrelation=lag_one(rho),
    )


def relative_error_percent(tau: Vector, rho: Vector) -> float | None:
    """100 |rho| / |tau|; None where there is no torque to compare with."""
    norm = np.linalg.norm(tau)
    return float(100.0 * np.linalg.norm(rho) / norm) if norm > 0 else None


def hac_sigma(W: Vector, rho: Vector, n: int) -> Vector:
    """Standard deviations (b,) that hold for correlated residuals (Newey and West).

    W (r, b) and rho (r,) are weighted, stacked joint by joint, n joints of equally many rows. The scores of all joints at
    one instant are added first, so correlation between joints counts as well as correlation in time; the window spans
    1.3 sqrt(T) of the T instants. The formula's own deviations assume white residuals.
    """
    scores = (W * rho[:, None]).reshape(n, -1, W.shape[1]).sum(axis=0)  # (T, b)
    T = len(scores)
    lags = int(np.ceil(1.3 * np.sqrt(T)))
    S = scores.T @ scores
    for lag in range(1, min(lags, T - 1) + 1):
        G = scores[lag:].T @ scores[:-lag]
        S += (1.0 - lag / (lags + 1.0)) * (G + G.T)
    norms = np.linalg.norm(W, axis=0)
    R = np.linalg.qr(W / norms, mode="r")
    bread = linalg.solve_triangular(R, np.eye(len(norms))) / norms[:, None]
    C = bread @ (bread.T @ S @ bread) @ bread.T
    small_sample = len(W) / max(1, len(W) - W.shape[1])
    return np.asarray(np.sqrt(small_sample * np.maximum(np.diag(C), 0.0)))
