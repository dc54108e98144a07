"""Tests for efforts and positions that are not what they are taken for.

Such efforts and positions are exchanged, of the wrong sign, zero or unit, or beyond their limit.

Least squares shows which of the `mistakes` fits best once it is undone. A wrong sign fits nearly as
well, but its motor takes power from the robot: it brakes.

With R the motor matrix, G the drive gains, z the zeros, and m and v the positions and efforts that
the motors report, a description says that q = R⁻¹ m + z and tau = RᵀG v. A mistake is undone by

    q' = P q + t,    tau' = A tau,    g' = g + d,

with gravity g. With S the exchange of two motors or the sign of one, A = RᵀG S (RᵀG)⁻¹ and
P = R⁻¹ S R; a table of joint values may have them by joint, A = P = S. Several mistakes are undone
one after the other, so their maps are multiplied.

A corrected description has these maps if R' = R P⁻¹, z' = P z + t and G' = R'⁻ᵀ A Rᵀ G, with G'
diagonal and positive: signs of joints, zeros, gravity, and units of efforts. The others belong to
the import.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations
from typing import Any

import numpy as np

from acquisition.robot import RADIANS_AS_DEGREES, Robot

from ..arrays import Array, Bools, Ints
from ..estimation import relative_residual
from ..regression import Problem, sample_weights
from ..report import Cause, TrustResult
from .evidence import Case, TrustInputs, Words

MIN_BAD_PERCENT = 5.0  # torque error of a joint: below, nothing is tried unless a motor brakes
MAX_RATIO, MAX_RATIO_OF_BRAKE = 0.5, 0.95  # of the torque errors with a mistake undone and with it
SAME_ERROR = 1.005  # ratio of torque errors that do not decide between two mistakes
MAX_RISE = 1.001  # the same for a sign that may be wrong: that of a lone axis changes no error
SWAPS, REVERSED = ("efforts", "positions", "channels"), ("effort", "position", "backwards")
ROUNDING = 9  # digits of the maps of equal mistakes
DEGREES = 180 / np.pi  # per rad
# Of each kind of mistake its text, and what to change if no description can correct it.
TEXTS = {
    "efforts": (
        "the efforts of {0} and {1} are swapped",
        "swap both in columns of [effort] in map.toml",
    ),
    "positions": (
        "the positions of {0} and {1} are swapped",
        "swap both in columns of [position] and [reference] in map.toml",
    ),
    "channels": (
        "the channels of {0} and {1} are swapped",
        "swap both in all columns of map.toml, or node of both in [[bus.drive]]",
    ),
    "effort": (
        "the effort of {0} has the wrong sign",
        "set signs = {efforts} in [effort] of map.toml, or effort_sign in [[bus.drive]]",
    ),
    "position": (
        "the position of {0} has the wrong sign",
        "set signs = {positions} in [position] and [reference] of map.toml, or sign and "
        "effort_sign in [[bus.drive]]",
    ),
    "backwards": ("position and effort of {0} have the wrong sign", "reverse its ratio"),
    "degrees": (
        "the position of {0} is in rad, declared as degrees",
        'set unit = "rad" in [position] and [reference] of map.toml',
    ),
    "zero": ("the zero of {0} is wrong by {figure:g} deg", "correct its zero_deg"),
    "gravity": ("gravity points along {0} of the base (gravity_m_s2)", "set gravity_m_s2"),
    "unit": (
        "the efforts are {figure:g} times the true ones",
        "correct unit in [effort] of map.toml, such as A to mA",
    ),
    "side": ("the efforts are those of the {0}s", 'set side = "{0}" in [effort] of map.toml'),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Undone:
    """Mistakes, and the maps that undo them: A, P (n, n), t (n,), and d (3,), added to gravity.

    Without causes it is the recording as it is.
    """

    causes: tuple[Cause, ...]
    A: Array
    P: Array
    t: Array
    d: Array

    def after(self, other: "Undone") -> "Undone":
        """Return the maps that undo the other first, and then this."""
        return Undone(
            causes=(*other.causes, *self.causes),
            A=self.A @ other.A,
            P=self.P @ other.P,
            t=self.P @ other.t + self.t,
            d=self.d + other.d,
        )

    @property
    def text(self) -> str:
        """The mistakes in words."""
        return ", and ".join(TEXTS[x.kind][0].format(*x.of, figure=x.figure) for x in self.causes)

    def keys(self, robot: Robot) -> tuple[Array, Array, Array] | None:
        """Return R' (n, n), z' (n,) and the factors (n,) on drive gains of a corrected description.

        The result is None if no description has these maps. It needs each motor at its joint, and a
        gain that changes must be the only key in the unit of the effort.
        """
        R = (robot.R @ np.linalg.inv(self.P)).round(ROUNDING)
        factors = np.linalg.solve(R.T, self.A @ robot.R.T).round(ROUNDING)
        gains = np.diag(factors)
        holds = (
            abs(np.linalg.det(self.P)).round(ROUNDING) == 1  # positions have the right unit
            and np.diag(R).all()
            and np.count_nonzero(factors) == robot.n == np.count_nonzero(gains > 0)
            and (
                (gains == 1).all()
                or (
                    not robot.controller.structure
                    and all(
                        m.drive_gain and not (m.saturation or m.drive_gain_half_width)
                        for m in robot.motors
                    )
                )
            )
        )
        return (R, self.P @ robot.zero + self.t, gains) if holds else None

    def advice(self, robot: Robot) -> str:
        """Return what to do about the mistakes."""
        E, P = (np.where(np.diag(x) < 0, -1, 1).tolist() for x in (self.A, self.P))
        each = (TEXTS[x.kind][1].format(*x.of, efforts=E, positions=P) for x in self.causes)
        return (
            f"Check this: {'; '.join(dict.fromkeys(each))}, and import again."
            if self.keys(robot) is None
            else "Check this; `fit --write-corrected ROBOT.toml` writes a corrected description."
        )


def mistakes(robot: Robot) -> list[Undone]:
    """Return the ways to undo one mistake, each once, first none."""
    n, one, R, zero = robot.n, np.eye(robot.n), robot.R, robot.zero
    to_joints, turning = R.T * robot.gain, np.array([x.type == "revolute" for x in robot.joints])
    motors, joints = ([x.name for x in each] for each in (robot.motors, robot.joints))
    g, axes = robot.gravity * (not robot.gravity[:2].any()), [*np.eye(3), *-np.eye(3)]
    exchanged = [
        *(
            (SWAPS, (i, j), one - np.outer(x := one[i] - one[j], x))
            for i, j in combinations(range(n), 2)
        ),
        *((REVERSED, (k,), one - 2 * np.diag(one[k])) for k in range(n)),
        (REVERSED, (), -one),
    ]
    rows: list[tuple[Cause, dict[str, Any]]] = [
        *(
            (
                Cause(kind, tuple(names[k] for k in at) or ("all joints",)),
                {"A": ours, "P": theirs, "t": zero - theirs @ zero},
            )
            for kinds, at, S in exchanged
            for names, A, P in (
                (motors, to_joints @ S @ np.linalg.inv(to_joints), np.linalg.solve(R, S @ R)),
                (joints, S, S),
            )
            for kind, ours, theirs in zip(kinds, (A, one, A), (one, P, P), strict=True)
        ),
        *(
            (Cause("degrees", (of,)), {"P": np.diag(x), "t": zero - x * zero})
            for of, which in (("all joints", np.ones(n)), *zip(joints, one, strict=True))
            for x in [DEGREES ** (which * turning)]
        ),
        *(
            (Cause("zero", (name,), deg), {"t": -x * turning * deg / DEGREES})
            for deg in (-90.0, 90.0, 180.0)
            for name, x in zip(joints, one, strict=True)
        ),
        *(
            (Cause("gravity", (axis,)), {"d": np.linalg.norm(g) * along - g})
            for axis, along in zip(("+x", "+y", "+z", "-x", "-y", "-z"), axes, strict=True)
        ),
        # as mA for A; a factor of 100 may be a gear ratio
        *((Cause("unit", (), factor), {"A": one / factor}) for factor in (1e3, 1e-3)),
        (Cause("side", ("motor",)), {"A": R.T}),
        (Cause("side", ("joint",)), {"A": np.linalg.inv(R.T)}),
    ]
    none = {"A": one, "P": one, "t": np.zeros(n), "d": np.zeros(3)}
    found = [
        Undone(causes=(), **none),
        *(Undone(causes=(cause,), **none | maps) for cause, maps in rows),
    ]
    keys = [np.r_[x.A.flat, x.P.flat, x.t, x.d].round(ROUNDING) + 0.0 for x in found]
    return [found[k] for k in np.sort(np.unique(keys, axis=0, return_index=True)[1])]


def undo(robot: Robot, causes: Iterable[Cause]) -> Undone:
    """Return the maps that undo these mistakes, the first one first."""
    each = {x.causes: x for x in mistakes(robot)}
    return reduce(lambda done, cause: each[(cause,)].after(done), causes, each[()])


def signs_and_order_test(evidence: TrustInputs) -> TrustResult | None:
    """Test for swapped channels and wrong signs.

    Undo each candidate mistake in turn, and report it if that halves the torque error. For the sign
    of a motor that absorbs power a lower torque error is enough.
    """
    rows, R = evidence.observed, evidence.robot.R
    rho, size = (
        np.linalg.norm(x * (rows.share > 0), axis=0)
        for x in (rows.tau - evidence.predicted, rows.tau)
    )
    power, brakes = _power(evidence)
    if len(R) == 1 or not ((100 * rho > MIN_BAD_PERCENT * size).any() or brakes.any()):
        return None
    braking = {
        Cause(kind, (motor.name,))
        for motor, it in zip(evidence.robot.motors, brakes, strict=True)
        for kind in REVERSED[:2]
        if it
    }
    tried = [
        x for x in mistakes(evidence.robot) if all(c.kind in (*SWAPS, *REVERSED) for c in x.causes)
    ]
    with_it, *errors = errors_of(evidence, tried)
    found = [
        (error / (MAX_RATIO_OF_BRAKE if braking.intersection(x.causes) else MAX_RATIO), error, x)
        for error, x in zip(errors, tried[1:], strict=True)
        if (x.P.T @ x.A * power).sum() > 0
    ]
    least, error, best = min(found, key=lambda one: one[0])
    return SIGNS.judge(
        {"mistake": least < with_it},
        # It is not clear which one it is if another is as good.
        causes=best.causes * (sum(x < SAME_ERROR * error for _, x, _ in found) == 1),
        mistake=best.text,
        mend=best.advice(evidence.robot),
        undone=100 * error,
        error=100 * with_it,
    )


SIGNS = Words(
    test="signs and order",
    place=10,
    by=signs_and_order_test,
    of_data=True,
    advice="Fit with `--write-corrected`, or correct columns and signs and import again.",
    detects="Swapped channels, and wrong signs of efforts or positions. Corrections are tried if a "
    "torque error is more than 5 %, or a motor absorbs power",
    limit="`do not use`: a correction reduces the torque error to half or less (to 95 % or less, "
    "if it is the sign of a motor that absorbs power)",
    cases={
        "mistake": Case(
            "do not use",
            "{mistake}: if this is undone, the torque errors of the joints fall from {error:.2g} % "
            "to {undone:.2g} % (rms)",
            "{mend}",
            "{mistake}",
        )
    },
)


def _power(evidence: TrustInputs) -> tuple[Array, Bools]:
    """Return the sums (n, n) of joint speeds times torques, and a mask (n,) of motors.

    The motors of the mask absorb power.
    """
    power, R = evidence.observed.speed.T @ evidence.observed.tau, evidence.robot.R
    return power, np.diag(R @ power @ np.linalg.inv(R)) < 0


def sign_may_be_wrong(evidence: TrustInputs, joint: str) -> bool:
    """Test whether the sign of the effort or position of a joint may be wrong.

    It may be if a motor of this joint brakes, or if turning the sign of its effort or position does
    not raise the torque error.
    """
    names = [one.name for one in evidence.robot.joints]
    motors = np.flatnonzero(evidence.robot.R[:, names.index(joint)])
    return bool(_power(evidence)[1][motors].any() or turned_sign(evidence, motors)[0] <= MAX_RISE)


def turned_sign(evidence: TrustInputs, motors: Collection[int] | Ints) -> tuple[float, str]:
    """Find the sign whose reversal leaves the smallest torque error, among these motors.

    Return that error divided by the present one, and the mistake that it would undo.
    """
    names = {evidence.robot.motors[m].name for m in motors}
    tried = [
        x
        for x in mistakes(evidence.robot)
        if all(c.kind in REVERSED[:2] and names.issuperset(c.of) for c in x.causes)
    ]
    with_it, *errors = errors_of(evidence, tried)
    each = zip(errors, tried[1:], strict=True)
    return min((error / max(with_it, 1e-300), x.text) for error, x in each)


def errors_of(evidence: TrustInputs, tried: Sequence[Undone]) -> list[float]:
    """Return the relative torque errors of least squares with mistakes undone, but for gravity."""
    problem = evidence.problem.with_samples().first_minutes()
    motions = {(x.P.tobytes(), x.t.tobytes()): x for x in tried}
    decimated = _decimated(problem)
    factors = {key: _factors(problem, decimated, x) for key, x in motions.items()}
    return [_error(factors[x.P.tobytes(), x.t.tobytes()], x.A) for x in tried]


def _decimated(problem: Problem) -> tuple[list[Array], Array]:
    """Return the decimated motion q, dq, ddq (rows, n), and the torques.

    The torques have the shape (n, rows, n + 1). For each joint these are all drives' torques and
    the external one. Columns are
    computed of this motion and not decimated themselves: that is ten times as fast, and as good for
    errors of this size. The delay is the known one, because an estimated delay would contain the
    mistake.
    """
    signals, s = problem.signals, problem.settings
    motion = problem.motion.between(s.start, s.stop, s.cutoff_hz)
    moved = [
        s.decimator.filtered(x.T).T / s.decimator.gain for x in (motion.q, motion.dq, motion.ddq)
    ]
    known = 0 * motion.tau if (x := signals.known_torque) is None else x[s.start : s.stop]
    drives, known = (
        s.decimator.filtered(one.T)
        for one in (problem.drives(s.start, s.stop, s.known_lag.value_s), known)
    )
    return moved, np.array([np.c_[drives.T, of_joint] for of_joint in known])


def _factors(problem: Problem, decimated: tuple[list[Array], Array], undone: Undone) -> Array:
    """Return QR factors (n, k, b + n + 1) of each joint's rows, with positions that are `undone`.

    The columns come first, then the torques of `decimated`.
    """
    rows = slice(None, None, 1 + len(decimated[0][0]) // 2000)  # as good for errors of this size
    (q, dq, ddq), torques = [x[rows] @ undone.P.T for x in decimated[0]], decimated[1][:, rows]
    W = problem.model.regressor(q + undone.t, dq, ddq)[..., problem.base.columns]
    of = np.abs(undone.P) / np.abs(undone.P).sum(axis=1, keepdims=True)
    share = (of @ sample_weights(problem).of_rows[rows].T)[..., None]
    return np.asarray(
        np.linalg.qr(share * np.concatenate([W.swapaxes(0, 1), torques], axis=2), mode="r")
    )


def _error(factors: Array, A: Array) -> float:
    """Return the relative torque error (rms over the joints) of weighted least squares.

    The drives' torques are mapped by A.
    """
    b = factors.shape[2] - len(A) - 1
    Y = np.einsum("jkm,jm->jk", factors[..., b:], np.c_[A, np.ones(len(A))])
    weight = 1 / np.maximum(np.linalg.norm(Y, axis=1), 1e-300)
    rows = np.concatenate([factors[..., :b], Y[..., None]], axis=2) * weight[:, None, None]
    R = np.asarray(np.linalg.qr(rows.reshape(-1, b + 1), mode="r"))
    return relative_residual(R[:, :-1], R[:, -1])


def positions_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether positions look like radians that were declared as degrees."""
    radians = any(RADIANS_AS_DEGREES in one.settings.warnings for one in evidence.problems)
    return POSITIONS.judge({"radians": radians}, text=RADIANS_AS_DEGREES)


POSITIONS = Words(
    test="positions",
    place=30,
    by=positions_test,
    of_data=True,
    advice="Check whether the positions are radians that were declared as degrees.",
    detects="Positions that look like radians declared as degrees",
    limit="`caution`: revolute joints move within 1/57 of their limits",
    cases={
        "radians": Case(
            "caution",
            "{text}",
            "Check the unit of the positions in map.toml.",
            "radians declared as degrees?",
        )
    },
)


def effort_test(evidence: TrustInputs) -> TrustResult | None:
    """Test for recorded efforts above a limit given in robot.toml, which no drive can reach."""
    found = dict.fromkeys(x for problem in evidence.problems for x in problem.settings.overloads)
    return EFFORT.judge({"beyond": found}, overloads="; ".join(found))


EFFORT = Words(
    test="effort",
    place=230,
    by=effort_test,
    of_data=True,
    advice="Check drive gain, ratio and unit, or correct the limit.",
    detects="Recorded efforts above `effort_nm`, `effort_n`, `saturation` or the URDF's `effort`. "
    "Skipped with `--gains`",
    limit="`caution`: at least 20 % above",
    cases={
        "beyond": Case(
            "caution",
            "{overloads}",
            "Check drive_gain, ratio and unit of the effort, or correct the limit.",
            "effort above its limit",
        )
    },
)
