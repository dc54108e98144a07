"""Tests for efforts and positions that are not what they are taken for.

Such efforts and positions are exchanged, of the wrong sign or unit, or beyond their limit.

A mistake S of the motors' columns, an exchange or a sign, is its own inverse. Undoing it makes of
the drives' torques at joints Rᵀ G S (Rᵀ G)⁻¹ tau, and of positions R⁻¹ S R q; a table of joint
torques may have them exchanged by joint. Least squares shows which mistake fits. A wrong sign fits
nearly as well, but its motor takes power from the robot: it brakes.
"""

from collections.abc import Collection, Iterator
from itertools import combinations

import numpy as np

from acquisition.robot import RADIANS_AS_DEGREES

from ..arrays import Array, Bools, Ints
from ..estimation import relative_residual
from ..regression import Problem, sample_weights
from ..report import TrustResult
from .evidence import Case, TrustInputs, Words

MIN_BAD_PERCENT = 5.0  # torque error of a joint: below, nothing is tried unless a motor brakes
MAX_RATIO, MAX_RATIO_OF_BRAKE = 0.5, 0.95  # of the torque errors with a mistake undone and with it
MAX_RISE = 1.001  # the same for a sign that may be wrong: that of a lone axis changes no error


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
    with_it, undone = _undone(evidence)
    found = [
        (tried / (MAX_RATIO if m is None or not brakes[m] else MAX_RATIO_OF_BRAKE), tried, mistake)
        for tried, mistake, m, A in undone
        if (A * power).sum() > 0
    ]
    least, error, finding = min(found, default=(np.inf, 0.0, ""), key=lambda one: one[0])
    return SIGNS.judge(
        {"mistake": least < with_it},
        mistake=finding,
        undone=100 * error,
        error=100 * with_it,
    )


SIGNS = Words(
    test="signs and order",
    place=10,
    by=signs_and_order_test,
    of_data=True,
    advice="Correct columns and signs (in the map, or of drives in robot.toml), and import again.",
    detects="Swapped efforts, and wrong signs of efforts or positions. If a torque error is more "
    "than 5 %, or a motor absorbs power, each such correction is tried in turn",
    limit="`do not use`: a correction reduces the torque error to half or less (to 95 % or less, "
    "if it is the sign of a motor that absorbs power)",
    cases={
        "mistake": Case(
            "do not use",
            "{mistake}: if this is undone, the torque errors of the joints fall from {error:.2g} % "
            "to {undone:.2g} % (rms)",
            "Check columns and signs of the recording.",
            "{mistake}",
        )
    },
    parts={
        "exchanged": "the efforts of {one} and {other} are swapped",
        "effort": "the effort of {one} has the wrong sign",
        "position": "the position of {one} has the wrong sign",
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
    j = [one.name for one in evidence.robot.joints].index(joint)
    motors = np.flatnonzero(evidence.robot.R[:, j])
    return bool(_power(evidence)[1][motors].any() or turned_sign(evidence, motors)[0] <= MAX_RISE)


def turned_sign(evidence: TrustInputs, motors: Collection[int] | Ints) -> tuple[float, str]:
    """Find the sign whose reversal leaves the smallest torque error, among these motors.

    Return that error divided by the present one, and the mistake that it would undo.
    """
    with_it, undone = _undone(evidence, motors)
    return min((tried / max(with_it, 1e-300), mistake) for tried, mistake, *_ in undone)


def _undone(
    evidence: TrustInputs, motors: Collection[int] | Ints | None = None
) -> tuple[float, list[tuple[float, str, int | None, Array]]]:
    """Return the torque error, and one entry for each mistake that is undone.

    An entry holds the error, the mistake, the motor of a sign, and the map (n, n) of torques times
    speeds. If `motors` are given, only their signs are tried.
    """
    problem, one = evidence.problem.with_samples().first_minutes(), np.eye(evidence.robot.n)
    factors = _factors(problem, decimated := _decimated(problem), one)
    return _error(factors, one), [
        (
            _error(factors if B is None else _factors(problem, decimated, B), A),
            mistake,
            motor,
            A if B is None else B.T @ A,
        )
        for mistake, motor, A, B in _mistakes(problem)
        if motors is None or motor in motors
    ]


def _mistakes(problem: Problem) -> Iterator[tuple[str, int | None, Array, Array | None]]:
    """Return mistakes, the motor of a sign, and the maps (n, n) of joint torques and of positions.

    The map of positions is None for a mistake of efforts.
    """
    robot, one = problem.robot, np.eye(problem.robot.n)
    by_motors, to_motors = robot.R.T * robot.gain, np.linalg.inv(robot.R.T * robot.gain)
    for i, j in combinations(range(robot.n), 2):
        S = one[[j if k == i else i if k == j else k for k in range(robot.n)]]
        for names, A in ((robot.motors, by_motors @ S @ to_motors), (robot.joints, S)):
            pair = {"one": names[i].name, "other": names[j].name}
            yield SIGNS.part("exchanged", **pair), None, A, None
    for m, motor in enumerate(robot.motors):
        S = one - 2 * np.diag(one[m])
        effort, position = (SIGNS.part(part, one=motor.name) for part in ("effort", "position"))
        yield effort, m, by_motors @ S @ to_motors, None
        yield position, m, one, np.linalg.solve(robot.R, S @ robot.R)


def _decimated(problem: Problem) -> tuple[list[Array], Array]:
    """Return the decimated motion q, dq, ddq (rows, n) from the zeros, and the torques.

    The torques have the shape (n, rows, n + 1). For each joint these are all drives' torques and
    the external one. For each joint these are all drives' torques and the external one. Columns are
    computed of this motion and not decimated themselves: that is ten times as fast, and as good for
    errors of this size. The delay is the known one, because an estimated delay would contain the
    mistake.
    """
    signals, s = problem.signals, problem.settings
    motion = problem.motion.between(s.start, s.stop, s.cutoff_hz)
    moved = [
        s.decimator.filtered(x.T).T / s.decimator.gain
        for x in (motion.q - signals.robot.zero, motion.dq, motion.ddq)
    ]
    known = 0 * motion.tau if (x := signals.known_torque) is None else x[s.start : s.stop]
    drives, known = (
        s.decimator.filtered(one.T)
        for one in (problem.drives(s.start, s.stop, s.known_lag.value_s), known)
    )
    return moved, np.array([np.c_[drives.T, of_joint] for of_joint in known])


def _factors(problem: Problem, decimated: tuple[list[Array], Array], B: Array) -> Array:
    """Return QR factors (n, k, b + n + 1) of each joint's rows, with positions mapped by B.

    The columns come first, then the torques of `decimated`.
    """
    (q, dq, ddq), torques = [x @ B.T for x in decimated[0]], decimated[1]
    W = problem.model.regressor(q + problem.signals.robot.zero, dq, ddq)[
        ..., problem.base.columns
    ].transpose(1, 0, 2)
    share = sample_weights(problem).of_rows.T[..., None]
    return np.asarray(np.linalg.qr(share * np.concatenate([W, torques], axis=2), mode="r"))


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
