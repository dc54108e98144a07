"""The columns of a motor's control law along the recorded reference and position,
and its least squares.
"""

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .filtering import lowpass
from .motion import differentiate, on_spline, spline_coefficients
from .settings import KnownLag

if TYPE_CHECKING:
    from .problem import Problem

FIRST_STEPS, STEPS, MAX_STEP, MIN_STEP = 3, 12, 2.0, 1e-2  # Gauss-Newton steps; samples of one
PRIOR_WEIGHT = 5.0  # deviations of the residual, more than one: it is not white
# low-pass over the rate of rows; of the paths; rows cut at each end
PASSBAND, SAMPLES_PER_ROW, EDGE_ROWS = 0.3, 8, 10
# of a motor's limit; share of the samples this near to a row
SATURATED, MAX_SATURATED, SATURATED_ROWS = 0.995, 0.01, 3
MAX_USED_S, MAX_ROWS, MAX_DELAY_S = 120.0, 600, 0.02
HOPELESS_PERCENT = 20.0  # after the first steps
MAX_RESIDUAL_PERCENT = 2.0  # of the effort's variation
_REMEMBERED = 32  # lags and delays of a path


@dataclass(frozen=True, kw_only=True, eq=False)
class LawSolution:
    """The law of a motor by some columns: values x of these, of the offset and others; d, L in
    s; the Jacobian [x d L].
    """

    x: Array
    d: float
    L: float
    J: Array
    rho: Array
    percent: float


class MotorPaths:
    """Reference and position of a motor as smooth paths, and the rows at which
    its effort is compared.
    """

    def __init__(
        self,
        paths: tuple[Array, Array],
        u: Array,
        rest: Array,
        at: NDArray[np.intp],
        most: float,
    ) -> None:
        """`paths`: spline coefficients of r and q, each with two derivatives and the integral, at
        places `at`; `rest`: columns beside them; `most`: delay. Times are in samples of the paths.
        """

        def moved(L: float, d: float, c: Array) -> Array:
            whole, part = divmod(-L - d, 1.0)
            return on_spline(at + int(whole), np.asarray(part), c).T

        # Structures and steps share most of their lags and delays.
        self._r, self._q = (lru_cache(_REMEMBERED)(partial(moved, c=c)) for c in paths)
        self.u, self._rest, self._most = u, rest, most
        self._size = max(float(np.linalg.norm(u - u.mean())) if len(u) else 0.0, 1e-300)

    def solve(
        self,
        letters: str,
        known: KnownLag,
        clock: tuple[float, float],
        near: LawSolution | None = None,
    ) -> LawSolution:
        """Least squares by the columns `letters`; `clock`: delay of the speed, period of the
        controller; `near`: the solution of another delay of the speed.
        """
        if near is not None and near.percent < MAX_RESIDUAL_PERCENT:
            return self._refine(letters, (near.d, near.L), known, clock)
        found = list[LawSolution]()
        for by in ("i", "e") if "i" in letters else ("e",):
            d = self._first_delay(letters, by, known, clock)
            found.append(self._refine(letters, (d, known.value_s), known, clock))
            if found[-1].percent < MAX_RESIDUAL_PERCENT:
                break
        return min(found, key=lambda one: one.percent)

    def _columns(
        self, letters: str, at: tuple[float, float], clock: tuple[float, float]
    ) -> tuple[Array, ...]:
        """Columns (rows, k) at d and L, and their derivatives by d and by L."""
        d, L = at
        r, dr, ddr, ir = self._r(L, d)
        q, dq, _, iq = self._q(L, 0.0)
        v, dv = self._q(L, clock[0])[1:3]
        e, de, none, half = r - q, dr - dq, 0.0 * r, 0.5 * clock[1]
        found = {
            "e": lambda: (e, -dr, -de),
            "f": lambda: (dr - v, -ddr, dv - ddr),
            "v": lambda: (-v, none, dv),
            "w": lambda: (dr, -ddr, -ddr),
            "i": lambda: (ir - iq + half * e, -r - half * dr, -e - half * de),
            "q": lambda: (-q, none, dq),
        }
        return tuple(np.array(x).T for x in zip(*(found[one]() for one in letters), strict=True))

    def _first_delay(
        self, letters: str, by: str, known: KnownLag, clock: tuple[float, float]
    ) -> float:
        """The delay by columns of what it adds to the error, -d dr, or to its integral, -d r,
        which grows without bound.
        """
        d, letter = 0.0, "w" if by == "e" and "w" in letters else by
        for _ in range(FIRST_STEPS):
            c, by_d, _ = self._columns(letters, (d, known.value_s), clock)
            added = [
                by_d[:, letters.index(one)]
                for one in dict.fromkeys((letter if by == "e" else "e", letter))
            ]
            x = scaled_solution(np.column_stack([c, self._rest, *added]), self.u)
            gain = x[letters.index(letter)]
            step = x[-1] / gain if gain else 0.0
            d = float(np.clip(d + step, -self._most, self._most))
            if abs(step) < MIN_STEP:
                break
        return d

    def _refine(
        self,
        letters: str,
        start: tuple[float, float],
        known: KnownLag,
        clock: tuple[float, float],
    ) -> LawSolution:
        """Gauss-Newton steps of the values, d and L, which is known within limits; a law far
        from the effort is left.
        """
        (d, L), step, k = start, np.inf, len(letters)
        for number in range(STEPS):
            c, by_d, by_L = self._columns(letters, (d, L), clock)
            c = np.hstack([c, self._rest])
            x = scaled_solution(c, self.u)
            rho = self.u - c @ x
            J = np.hstack([c, (by_d @ x[:k])[:, None], (by_L @ x[:k])[:, None]])
            percent = 100 * float(np.linalg.norm(rho)) / self._size
            if step < MIN_STEP or (number == FIRST_STEPS and percent > HOPELESS_PERCENT):
                break
            weight = PRIOR_WEIGHT * rho.std() / max(known.sd_s, self._most / 10)
            A = np.vstack([J, np.r_[np.zeros(J.shape[1] - 1), weight]])
            moves = np.clip(
                scaled_solution(A, np.r_[self.u, weight * (known.value_s - L)])[-2:],
                -MAX_STEP,
                MAX_STEP,
            )
            (d, L), step = (
                np.clip([d + moves[0], L + moves[1]], -self._most, self._most).tolist(),
                np.abs(moves).max(),
            )
        return LawSolution(x=x, d=d, L=L, J=J, rho=rho, percent=percent)


def scaled_solution(A: Array, y: Array) -> Array:
    """Least squares by columns of norm one; of a column of zeros the value is zero."""
    norm = np.linalg.norm(A, axis=0)
    scale = np.where(norm > 0, norm, 1.0)
    return np.asarray(np.linalg.lstsq(A / scale, y)[0] / scale)


def motor_paths(problem: "Problem") -> tuple[list[MotorPaths], float]:
    """The motors of a recording, and the rate of their paths."""
    s, settings, R = problem.signals, problem.settings, problem.signals.robot.R
    fs, n_d = s.sample_rate_hz, settings.decimation
    stop, step = (
        min(settings.stop, settings.start + round(MAX_USED_S * fs)),
        max(1, n_d // SAMPLES_PER_ROW),
    )
    used = slice(settings.start, stop)
    assert s.q_ref is not None
    u, first = s.robot.motor_effort(s.effort[used]), s.q_ref[used.start] @ R.T
    limits = np.array(
        [np.inf if m.saturation is None else SATURATED * m.saturation for m in s.robot.motors]
    )
    saturated = np.cumsum(
        (np.abs(u) >= limits) | ~problem.measured_samples()[used, None],  # neither follows the law
        axis=0,
    )
    u = u if s.feedforward is None else u - s.feedforward[used]
    r, q, u = (
        lowpass(x, PASSBAND * fs / n_d, fs)
        for x in (s.q_ref[used] @ R.T - first, s.q[used] @ R.T - first, u)
    )
    edge = EDGE_ROWS * n_d + math.ceil(MAX_DELAY_S * fs)
    apart = max(n_d, (len(u) - 2 * edge) // MAX_ROWS)
    at = np.arange(edge - edge % step, len(u) - edge, max(step, apart - apart % step))
    ends = [np.clip(at + way * SATURATED_ROWS * n_d, 0, len(u) - 1) for way in (1, -1)]
    near: NDArray[np.intp] = np.asarray(saturated[ends[0]] - saturated[ends[1]])
    free = near <= MAX_SATURATED * 2 * SATURATED_ROWS * n_d
    paths = [_paths(x, step) for x in (r, q)]
    held = np.zeros((len(at), s.robot.n, 0))
    if s.robot.controller.gravity_feedforward:
        inverse = np.linalg.inv(R)
        still = problem.model.regressor((q[at] + first) @ inverse.T, 0 * q[at], 0 * q[at])[
            ..., problem.base.columns
        ]
        held = np.einsum("jm,ajp->amp", inverse, still)
    found = []
    for j in range(s.robot.n):
        own = held[:, j][:, held[:, j].any(axis=0)]
        rest = np.c_[np.ones(len(at)), own][free[:, j]]
        places, own_paths = at[free[:, j]] // step, (paths[0][j], paths[1][j])
        found.append(
            MotorPaths(own_paths, u[at, j][free[:, j]], rest, places, MAX_DELAY_S * fs / step)
        )
    return found, fs / step


def _paths(x: Array, step: int) -> list[Array]:
    """By motor the spline coefficients of a path (N, n), of its two derivatives and its
    integral; times in its samples.
    """
    dx = differentiate(x, step)
    series = np.stack(
        [x, dx, differentiate(dx, step), (np.cumsum(x, axis=0) - 0.5 * x) / step], axis=-1
    )[::step]
    return [spline_coefficients(series[:, j]) for j in range(x.shape[1])]
