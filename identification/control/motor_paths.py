"""The columns of a motor's control law along reference and position, and their least squares."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from ..arrays import Array, Bools, Ints
from ..regression import Lag, Problem, differentiate, lowpass, on_spline, spline_coefficients

FIRST_STEPS, STEPS, MAX_STEP, MIN_STEP = 3, 12, 2.0, 1e-2  # Gauss-Newton steps; samples of one
PRIOR_WEIGHT = 5.0  # standard deviations of the residual; more than 1, as it is not white
# Low-pass over the rate of rows; samples of a path per row; rows cut at each end.
PASSBAND, SAMPLES_PER_ROW, EDGE_ROWS = 0.3, 8, 10
# Share of a motor's limit; share of the samples that may reach it, within so many rows.
SATURATED, MAX_SATURATED, SATURATED_ROWS = 0.995, 0.01, 3
MAX_USED_S, MAX_ROWS, MAX_DELAY_S = 120.0, 600, 0.02
HOPELESS_PERCENT = 20.0  # residual after the first steps, with which the search ends
MAX_RESIDUAL_PERCENT = 2.0  # of the effort's variation
_REMEMBERED = 32  # delays of a path whose values are kept

# x, dx, ddx and the integral of x (4, rows), by their delay in s
Path = Callable[[float], Array]

# Residual of an effort, percent, and x: values of the columns, of those beside them, d and L.
Found = tuple[float, Array]


class MotorPaths:
    """Reference and position of a motor as smooth paths, and rows at which efforts are compared.

    Attributes:
        u: (rows,) effort.
        rate_hz: sample rate of the paths, Hz.
        known: delay of the effort, by prior knowledge.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        beside: Array,
        rate_hz: float,
        known: Lag,
        period_s: float,
    ) -> None:
        """Store the paths.

        Parameters
        ----------
        paths : functions of a delay in s, for r and q, that return path, two derivatives and
            integral (4, rows).
        beside : (rows, k) further columns, and the effort as the last.
        rate_hz : sample rate of the paths, Hz.
        known : delay of the effort, by prior knowledge.
        period_s : period of the controller's sum, s.
        """
        (self._r, self._q), self._half_s = paths, 0.5 * period_s
        self._beside, self.u = beside[:, :-1], beside[:, -1]
        self.rate_hz, self.known = rate_hz, known

    def solve(self, letters: str, late_s: float, near: Found | None) -> Found:
        """Solve least squares by the columns `letters`, with the speed delayed by `late_s`.

        `near` is the solution with another delay of the speed.
        """
        if near is not None and near[0] < MAX_RESIDUAL_PERCENT:
            return self._refined(letters, late_s, near[1][-2:])
        found = list[Found]()
        for by in ("i", "e") if "i" in letters else ("e",):
            d = self._first_delay(letters, late_s, by)
            found.append(self._refined(letters, late_s, np.array([d, self.known.value_s])))
            if found[-1][0] < MAX_RESIDUAL_PERCENT:
                break
        return min(found, key=lambda one: one[0])

    def solved(self, letters: str, late_s: float, d: float, L: float) -> tuple[Array, Array, Array]:
        """Return the least-squares values at the delays d and L, residual (rows,), and columns.

        The columns are those of the values, of d and of L.
        """
        c, by_d, by_L = self._columns(letters, late_s, d, L)
        x = scaled_solution(c, self.u)
        own = x[: len(letters)]
        return x, self.u - c @ x, np.column_stack([c, by_d @ own, by_L @ own])

    def _columns(
        self, letters: str, late_s: float, d: float, L: float
    ) -> tuple[Array, Array, Array]:
        """Return columns (rows, k) at the delays d and L, and their derivatives by d and by L."""
        r, dr, ddr, ir = self._r(L + d)
        q, dq, _, iq = self._q(L)
        _, v, dv, _ = self._q(L + late_s)
        e, de, none, half_s = r - q, dr - dq, 0.0 * r, self._half_s
        found = {
            "e": (e, -dr, -de),
            "f": (dr - v, -ddr, dv - ddr),
            "v": (-v, none, dv),
            "w": (dr, -ddr, -ddr),
            "i": (ir - iq + half_s * e, -r - half_s * dr, -e - half_s * de),
            "q": (-q, none, dq),
        }
        c, by_d, by_L = np.array([found[one] for one in letters]).transpose(1, 2, 0)
        return np.c_[c, self._beside], by_d, by_L

    def _first_delay(self, letters: str, late_s: float, by: str) -> float:
        """Return a first delay d, from columns of what it adds to the error.

        That is -d dr for the error, and -d r, which grows without bound, for its integral.
        """
        d, letter = 0.0, "w" if by == "e" and "w" in letters else by
        added = [letters.index(one) for one in "e" * (by == "i") + letter]
        for _ in range(FIRST_STEPS):
            c, by_d, _ = self._columns(letters, late_s, d, self.known.value_s)
            x = scaled_solution(np.c_[c, by_d[:, added]], self.u)
            gain = x[letters.index(letter)]
            step_s = x[-1] / gain if gain else 0.0
            d = float(np.clip(d + step_s, -MAX_DELAY_S, MAX_DELAY_S))
            if abs(step_s) * self.rate_hz < MIN_STEP:
                break
        return d

    def _refined(self, letters: str, late_s: float, at: Array) -> Found:
        """Take Gauss–Newton steps of the values, d and L, from the delays `at` on.

        L is known within limits. The steps end early if the control law is far from the effort.
        """
        known, step = self.known, np.inf
        size = max(math.sqrt(len(self.u)) * self.u.std(), 1e-300)
        for number in range(STEPS):
            x, rho, J = self.solved(letters, late_s, *at)
            percent = 100 * float(np.linalg.norm(rho)) / size
            if step < MIN_STEP or (number == FIRST_STEPS and percent > HOPELESS_PERCENT):
                break
            weight = PRIOR_WEIGHT * rho.std() / max(known.sd_s, MAX_DELAY_S / 10)
            A = np.vstack([J, np.r_[np.zeros(J.shape[1] - 1), weight]])
            moves = scaled_solution(A, np.r_[self.u, weight * (known.value_s - at[1])])[-2:]
            moves = np.clip(self.rate_hz * moves, -MAX_STEP, MAX_STEP)
            at = np.clip(at + moves / self.rate_hz, -MAX_DELAY_S, MAX_DELAY_S)
            step = np.abs(moves).max()
        return percent, np.r_[x, at]


def scaled_solution(A: Array, y: Array) -> Array:
    """Solve least squares by columns of norm one; the value of a column of zeros is zero."""
    norm = np.linalg.norm(A, axis=0)
    scale = np.where(norm > 0, norm, 1.0)
    return np.asarray(np.linalg.lstsq(A / scale, y)[0] / scale)


def motor_paths(problem: Problem, known: Lag, period_s: float) -> list[MotorPaths]:
    """Return the paths of the motors of a recording.

    Parameters
    ----------
    problem : the recording.
    known : delay of the effort, by prior knowledge.
    period_s : period of the controller's sum, s.
    """
    s, settings, R = problem.signals, problem.settings, problem.signals.robot.R
    fs, n_d = s.sample_rate_hz, settings.decimator.factor
    first_s = settings.used[: round(MAX_USED_S * fs)]
    used, step = slice(first_s.start, first_s.stop), max(1, n_d // SAMPLES_PER_ROW)
    assert s.q_ref is not None
    u, first = s.robot.motor_effort(s.effort[used]), s.q_ref[used.start] @ R.T
    at = _row_places(len(u), n_d, fs)
    free = _follow_the_law(problem, u, used, at)
    u = u if s.feedforward is None else u - s.feedforward[used]
    r, q, u = (
        lowpass(x, PASSBAND * fs / n_d, fs)
        for x in (s.q_ref[used] @ R.T - first, s.q[used] @ R.T - first, u)
    )
    paths, held = [_paths(x, fs, step) for x in (r, q)], _gravity(problem, q[at] + first)
    each = zip(free.T, *paths, held.transpose(2, 0, 1), u[at].T, strict=True)
    return [
        MotorPaths(
            [_path(c, at[rows] // step, fs / step) for c in of_motor],
            np.column_stack(
                [np.ones(rows.sum()), *(x for x in gravity[:, rows] if x.any()), effort[rows]]
            ),
            fs / step,
            known,
            period_s,
        )
        for rows, *of_motor, gravity, effort in each
    ]


def _row_places(N: int, n_d: int, fs: float) -> Ints:
    """Return the samples, of N, of the rows at which efforts are compared.

    They are samples of the paths too, and away from the ends.
    """
    step, edge = max(1, n_d // SAMPLES_PER_ROW), EDGE_ROWS * n_d + math.ceil(MAX_DELAY_S * fs)
    apart = max(n_d, (N - 2 * edge) // MAX_ROWS)
    return np.arange(edge - edge % step, N - edge, max(step, apart - apart % step))


def _follow_the_law(problem: Problem, u: Array, used: slice, at: Ints) -> Bools:
    """Return a mask (rows, n), at the samples `at`, of rows that follow the control law.

    Few samples near them have an effort u (N, n) at its limit, or were not measured.
    """
    limited = np.abs(u) >= SATURATED * problem.signals.robot.saturation
    left: Ints = np.cumsum(limited | ~problem.measured_samples()[used, None], axis=0)
    far = SATURATED_ROWS * problem.settings.decimator.factor
    return np.asarray(left[at + far] - left[at - far] <= MAX_SATURATED * 2 * far)


def _gravity(problem: Problem, q: Array) -> Array:
    """Return motor efforts (b, rows, n) of gravity per base parameter, at motor positions q.

    There are no columns if gravity is not fed forward.
    """
    robot = problem.signals.robot
    if not robot.controller.gravity_feedforward:
        return np.zeros((0, *q.shape))
    inverse = np.linalg.inv(robot.R)
    still = problem.model.regressor(q @ inverse.T, 0 * q, 0 * q)
    return np.asarray(np.einsum("jm,ajp->pam", inverse, still[..., problem.base.columns]))


def _paths(x: Array, fs: float, step: int) -> list[Array]:
    """Return spline coefficients of a path (N, n), its two derivatives and its integral, by motor.

    They are those of every `step`-th sample.
    """
    dx, summed = differentiate(x, fs), (np.cumsum(x, axis=0) - 0.5 * x) / fs
    series = np.stack([x, dx, differentiate(dx, fs), summed], axis=-1)[::step]
    return [spline_coefficients(series[:, j]) for j in range(x.shape[1])]


def _path(c: Array, places: Ints, rate_hz: float) -> Path:
    """Return the path of these coefficients as a function of its delay, s.

    `places` are counted in its samples.
    """

    @lru_cache(_REMEMBERED)  # structures and steps share most of their delays
    def path(late_s: float) -> Array:
        whole, part = divmod(-late_s * rate_hz, 1.0)
        return on_spline(places + int(whole), np.asarray(part), c).T

    return path
